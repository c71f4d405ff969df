//! Flow: sizes, kept features, the real network through ONNX Runtime, and what is said when something is amiss.

mod full;
mod opening;

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    thread,
};

use nightflow::{
    clock::Stamp,
    exposure::{Exposed, Pair},
    flow::{
        Cause, Config, Error, Fake, Flow, Grid, Lender, Matcher, Operators, Own, Resolution, State, cores,
        priority::{self, Policy},
        runtime,
    },
};

/// A textured scene seen through a window that stands at `at`.
fn frame(width: usize, height: usize, at: (f64, f64), number: u64) -> Exposed {
    let mut rgb = Vec::with_capacity(3 * width * height);
    for c in 0..3 {
        for y in 0..height {
            for x in 0..width {
                let (x, y, c) = (x as f64 + at.0, y as f64 + at.1, f64::from(c));
                let coarse = (0.31 * x + 0.17 * y + c).sin() * (0.23 * y - 0.11 * x).cos();
                let fine = (0.9 * x - 0.4 * y).sin() * (0.7 * y + 0.5 * x + c).sin();
                rgb.push((0.4 + 0.2 * coarse + 0.12 * fine) as f32);
            }
        }
    }
    Exposed {
        stamp: Stamp::from_ns(number as i64 * 33_000_000),
        width,
        height,
        scale: [4.0, 4.0],
        rgb,
        saturated: vec![0; width * height],
        raw_mean: 0.05,
        gain: 8.0,
        generation: number,
        ..Exposed::default()
    }
}

fn pair<'a>(older: &'a Exposed, newer: &'a Exposed) -> Pair<'a> {
    Pair { older, newer, gain_step: None }
}

/// What the network gives, and no more.
fn quarter() -> Config {
    Config { refine: false, ..Config::default() }
}

fn full() -> Config {
    Config { resolution: Resolution::Full, ..quarter() }
}

/// A real network, if its golden check passes.
fn named(network: &str) -> Matcher {
    let config = Config { network: network.into(), ..quarter() };
    Matcher::open(&config).expect("the committed network opens and passes its golden check")
}

fn real() -> Matcher {
    named(&Config::default().network)
}

#[test]
fn a_known_shift_comes_back_in_camera_pixels_at_every_size() {
    for config in [quarter(), full()] {
        for (width, height) in [(320, 256), (100, 75), (64, 64), (30, 17), (3, 2), (1, 1)] {
            let mut older = frame(width, height, (0.0, 0.0), 1);
            older.scale = [4.0, 3.0];
            let newer = Exposed { generation: 2, ..older.clone() };
            let mut matcher = Matcher::with(&config, Box::new(Fake::shift(0.25, -0.5)));
            let mut own = Own::default();
            let flow = matcher.between(&pair(&older, &newer), &mut own).unwrap();
            let cells = match config.resolution {
                Resolution::Quarter => ((width / 4).max(1), (height / 4).max(1)),
                Resolution::Full | Resolution::Bilinear => (width, height),
            };
            let side = if config.resolution == Resolution::Quarter { 4.0 } else { 1.0 };
            let grid = Grid { width: cells.0, height: cells.1, scale: [4.0 * side, 3.0 * side] };
            assert_eq!(flow.grid, grid);
            assert_eq!(matcher.grid(&older), grid);
            assert_eq!((flow.vectors.len(), flow.confidence.len()), (2 * grid.cells(), grid.cells()));
            assert!(flow.vectors.chunks(2).all(|v| v == [1.0, -1.5]), "{width}x{height}");
        }
    }
}

#[test]
fn block_matching_finds_a_moved_scene_at_odd_sizes_and_on_both_rasters() {
    for config in [quarter(), full()] {
        // The window goes (3, −2), so the scene goes (−3, 2).
        let (older, newer) = (frame(150, 90, (0.0, 0.0), 1), frame(150, 90, (3.0, -2.0), 2));
        let mut matcher = Matcher::with(&config, Box::new(Fake::matching(5)));
        let mut own = Own::default();
        let flow = matcher.between(&pair(&older, &newer), &mut own).unwrap();
        let side = (flow.grid.scale[0] / 4.0) as usize;
        let margin = 12 / side;
        for row in margin..flow.grid.height - margin {
            for column in margin..flow.grid.width - margin {
                let vector = &flow.vectors[2 * (row * flow.grid.width + column)..][..2];
                let off = (vector[0] / 4.0 + 3.0).hypot(vector[1] / 4.0 - 2.0);
                assert!(off < 0.2, "row {row}, column {column}: {vector:?}");
            }
        }
    }
}

/// The plain way to pad: continue every row and column by walking to and fro, up to multiples of the network's stride.
fn continued(exposed: &Exposed, stride: usize) -> Exposed {
    let walk = |length: usize, to: usize| -> Vec<usize> {
        (0..length).chain((1..length - 1).rev()).cycle().take(to).collect()
    };
    let (width, height) = (exposed.width.next_multiple_of(stride), exposed.height.next_multiple_of(stride));
    let (columns, rows) = (walk(exposed.width, width), walk(exposed.height, height));
    let mut rgb = Vec::new();
    for plane in exposed.rgb.chunks(exposed.width * exposed.height) {
        for row in &rows {
            rgb.extend(columns.iter().map(|column| plane[row * exposed.width + column]));
        }
    }
    Exposed { width, height, rgb, saturated: vec![0; width * height], ..exposed.clone() }
}

/// At any size a step gives what the network gives for images that were padded by hand, cut to the frame.
fn padding_changes_nothing(mut matcher: Matcher, stride: usize, sizes: &[(usize, usize)]) {
    for &(width, height) in sizes {
        let (older, newer) = (frame(width, height, (0.0, 0.0), 1), frame(width, height, (2.0, 1.0), 2));
        let (mut cut, mut whole) = (Own::default(), Own::default());
        let cut = matcher.between(&pair(&older, &newer), &mut cut).unwrap();
        let (older, newer) = (continued(&older, stride), continued(&newer, stride));
        let whole = matcher.between(&pair(&older, &newer), &mut whole).unwrap();
        assert_eq!((cut.grid.width, cut.grid.height), (width / 4, height / 4));
        for row in 0..cut.grid.height {
            let line = |flow: &Flow| flow.vectors[2 * row * flow.grid.width..][..2 * cut.grid.width].to_vec();
            assert_eq!(line(&cut), line(&whole), "{width}x{height}, row {row}");
        }
    }
}

#[test]
fn an_odd_size_gives_what_padding_by_hand_gives() {
    let fake = Matcher::with(&quarter(), Box::new(Fake::matching(3)));
    padding_changes_nothing(fake, 64, &[(100, 60), (65, 127), (37, 41), (130, 64)]);
    padding_changes_nothing(real(), 32, &[(100, 60), (70, 129)]);
}

#[test]
fn the_full_raster_is_the_quarter_raster_between_its_cells() {
    let (older, newer) = (frame(128, 128, (0.0, 0.0), 1), frame(128, 128, (1.5, 0.5), 2));
    let (mut coarse, mut fine) = (Own::default(), Own::default());
    let quarter = Matcher::with(&quarter(), Box::new(Fake::matching(4)))
        .between(&pair(&older, &newer), &mut coarse)
        .unwrap()
        .vectors
        .to_vec();
    let mut matcher = Matcher::with(&full(), Box::new(Fake::matching(4)));
    let flow = matcher.between(&pair(&older, &newer), &mut fine).unwrap();
    // The middle two of a cell's four pixels stand 1/8 of a cell before and behind its centre, so their mean is 7/8 of the
    // cell and 1/16 of each neighbour.
    let weights = [0.0625, 0.875, 0.0625];
    for (row, column) in [(5, 7), (16, 16), (30, 3)] {
        for c in 0..2 {
            let mut want = 0.0;
            for (j, wy) in weights.iter().enumerate() {
                for (i, wx) in weights.iter().enumerate() {
                    want += wx * wy * quarter[2 * ((row + j - 1) * 32 + column + i - 1) + c];
                }
            }
            let mut got = 0.0;
            for y in 4 * row + 1..4 * row + 3 {
                for x in 4 * column + 1..4 * column + 3 {
                    got += flow.vectors[2 * (y * 128 + x) + c] / 4.0;
                }
            }
            assert!((got - want).abs() < 1e-4, "row {row}, column {column}: {got}, expected {want}");
        }
    }
}

#[test]
fn features_are_computed_once_a_frame_and_again_when_the_gain_changes() {
    let mut matcher = Matcher::with(&quarter(), Box::new(Fake::matching(1)));
    let mut own = Own::default();
    let mut older = frame(64, 64, (0.0, 0.0), 1);
    for number in 2..=10 {
        let newer = frame(64, 64, (0.0, 0.0), number);
        matcher.between(&pair(&older, &newer), &mut own).unwrap();
        older = newer;
    }
    assert_eq!(matcher.counts().described, 10);
    assert_eq!(matcher.counts().pairs, 9);
    // Another gain: the older frame was developed anew.
    older.generation = 11;
    let newer = frame(64, 64, (0.0, 0.0), 12);
    matcher.between(&pair(&older, &newer), &mut own).unwrap();
    assert_eq!(matcher.counts().described, 12);
    // Another size forgets everything.
    let (older, newer) = (frame(80, 64, (0.0, 0.0), 11), frame(80, 64, (0.0, 0.0), 12));
    matcher.between(&pair(&older, &newer), &mut own).unwrap();
    assert_eq!(matcher.counts().described, 14);
}

#[test]
fn kept_features_give_the_flow_that_fresh_ones_give() {
    let frames: Vec<_> = (1..=5).map(|n| frame(64, 64, (n as f64 * n as f64 * 0.5, 0.0), n)).collect();
    let mut kept = Matcher::with(&quarter(), Box::new(Fake::matching(6)));
    for two in frames.windows(2) {
        let (mut a, mut b) = (Own::default(), Own::default());
        let kept = kept.between(&pair(&two[0], &two[1]), &mut a).unwrap();
        let mut fresh = Matcher::with(&quarter(), Box::new(Fake::matching(6)));
        let fresh = fresh.between(&pair(&two[0], &two[1]), &mut b).unwrap();
        assert_eq!(kept.vectors, fresh.vectors);
    }
}

#[test]
fn saturated_cells_and_matches_outside_have_no_confidence() {
    let mut older = frame(64, 64, (0.0, 0.0), 1);
    older.saturated[5 * 64 + 9] = 1; // cell (1, 2)
    older.saturated_part = 1.0 / 4096.0;
    let mut newer = Exposed { generation: 2, saturated: vec![0; 4096], ..older.clone() };
    newer.saturated[31 * 64 + 31] = 1; // where cell (6, 6), of centre (25.5, 25.5), goes under (5.5, 5.5)
    let mut matcher = Matcher::with(&quarter(), Box::new(Fake::shift(5.5, 5.5).with_uncertainty(1.0)));
    let mut own = Own::default();
    let flow = matcher.between(&pair(&older, &newer), &mut own).unwrap();
    let at = |row: usize, column: usize| flow.confidence[row * 16 + column];
    assert_eq!((at(1, 2), at(1, 3)), (0.0, 1.0 - (-1.0f32).exp()));
    assert_eq!((at(6, 6), at(6, 7)), (0.0, 1.0 - (-1.0f32).exp()));
    // Pixel 57.5 + 5.5 = 63 is the last one inside, 61.5 + 5.5 = 67 is outside.
    assert!(at(14, 3) > 0.0 && at(15, 3) == 0.0 && at(3, 14) > 0.0 && at(3, 15) == 0.0);
}

#[test]
fn flow_that_is_no_number_spoils_the_step_and_is_counted() {
    let (older, newer) = (frame(70, 64, (0.0, 0.0), 1), frame(70, 64, (0.0, 0.0), 2));
    let mut matcher = Matcher::with(&quarter(), Box::new(Fake::shift(f32::NAN, 1.0)));
    let error = matcher.between(&pair(&older, &newer), &mut Own::default()).unwrap_err();
    insta::assert_snapshot!(error, @"the network gave 512 of 1024 flow values and 0 of 512 uncertainties that are not finite");
}

#[test]
fn frames_that_make_no_pair_are_refused() {
    let (older, newer) = (frame(64, 64, (0.0, 0.0), 1), frame(64, 60, (0.0, 0.0), 2));
    let mut matcher = Matcher::with(&quarter(), Box::new(Fake::shift(0.0, 0.0)));
    let error = matcher.between(&pair(&older, &newer), &mut Own::default()).unwrap_err();
    insta::assert_snapshot!(error, @"the older frame (width, height, scale) is (64, 64, [4.0, 4.0]), the newer (64, 60, [4.0, 4.0])");
    let torn = Exposed { rgb: vec![0.0; 7], ..older.clone() };
    let error = matcher.between(&pair(&torn, &older), &mut Own::default()).unwrap_err();
    insta::assert_snapshot!(error, @"an image of 64 × 64 pixels has 7 values and 4096 of saturation");
}

/// The state of a step in which everything is well but what `change` spoils.
fn state(uncertainty: f32, change: impl Fn(&mut Exposed, &mut Option<f32>)) -> State {
    let older = frame(64, 64, (0.0, 0.0), 1);
    let mut newer = frame(64, 64, (0.0, 0.0), 2);
    let mut gain_step = None;
    change(&mut newer, &mut gain_step);
    let pair = Pair { older: &older, newer: &newer, gain_step };
    let mut matcher = Matcher::with(&quarter(), Box::new(Fake::shift(0.0, 0.0).with_uncertainty(uncertainty)));
    let mut own = Own::default();
    let flow: Flow = matcher.between(&pair, &mut own).unwrap();
    let (state, mean) = matcher.judge(&pair, &flow);
    let expected = 1.0 - (-1.0 / uncertainty).exp();
    assert!((mean - expected).abs() < 1e-5, "mean confidence {mean}, expected {expected}");
    state
}

#[test]
fn every_cause_is_named_with_its_figure() {
    assert_eq!(state(0.5, |_, _| ()), State::Ok);
    let dark = |raw_mean, needed| Cause::Dark { raw_mean, needed };
    assert_eq!(state(0.5, |f, _| f.raw_mean = 0.002), State::Ok);
    assert_eq!(state(0.5, |f, _| f.raw_mean = 0.0019), State::Degraded(dark(0.0019, 0.002)));
    assert_eq!(state(0.5, |f, _| f.raw_mean = 0.0009), State::Blind(dark(0.0009, 0.001)));
    assert!(matches!(state(0.5, |f, _| f.raw_mean = f32::NAN), State::Blind(Cause::Dark { .. })));
    let saturated = |part, allowed| Cause::Saturated { part, allowed };
    assert_eq!(state(0.5, |f, _| f.saturated_part = 0.2), State::Degraded(saturated(0.2, 0.1)));
    assert_eq!(state(0.5, |f, _| f.saturated_part = 0.6), State::Blind(saturated(0.6, 0.5)));
    assert!(matches!(state(3.0, |_, _| ()), State::Degraded(Cause::Unsure { needed: 0.3, .. })));
    assert!(matches!(state(12.0, |_, _| ()), State::Blind(Cause::Unsure { needed: 0.1, .. })));
    assert_eq!(state(0.5, |_, step| *step = Some(3.5)), State::Degraded(Cause::GainStep { factor: 3.5 }));
    assert_eq!(state(0.5, |f, _| f.frozen = true), State::Blind(Cause::Frozen));
    // What was measured in the raw goes before what the network says, and blind before degraded.
    assert_eq!(state(12.0, |f, _| f.raw_mean = 0.0), State::Blind(dark(0.0, 0.001)));
    assert!(matches!(state(12.0, |_, step| *step = Some(3.0)), State::Blind(Cause::Unsure { .. })));
}

#[test]
fn every_committed_network_passes_its_golden_check() {
    assert_eq!(real().model().name, "pwcnet_fcdn");
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    // Those that are flown, and those that are there to be compared.
    for folder in [models.clone(), models.join("recipes")] {
        let manifest = fs::read_to_string(folder.join("manifest.toml")).unwrap();
        for name in manifest.parse::<toml::Table>().unwrap().keys() {
            let mut matcher =
                Matcher::open(&Config { network: name.into(), models: folder.clone(), ..quarter() }).unwrap();
            let deviation = matcher.check_golden().unwrap().expect("the manifest holds a golden output");
            assert!(deviation.worst <= deviation.tolerance);
            let model = matcher.model();
            assert_eq!(&model.name, name);
            assert!(model.provider.starts_with("CPUExecutionProvider of ONNX Runtime 1."), "{model:?}");
            assert!(
                model.sha256.len() == 2
                    && model.sha256.iter().all(|(file, hash)| file.ends_with(".onnx") && hash.len() == 64)
            );
        }
    }
}

/// Lends one place, and remembers where that was.
#[derive(Default)]
struct Watched {
    own: Own,
    lent_at: Vec<*const f32>,
}

impl Lender for Watched {
    fn lend(&mut self, grid: &Grid) -> nightflow::flow::Canvas<'_> {
        let canvas = self.own.lend(grid);
        self.lent_at.push(canvas.flow.as_ptr());
        canvas
    }

    fn lent(&self) -> (&[f32], &[f32]) {
        self.own.lent()
    }
}

#[test]
fn a_network_writes_into_the_lent_memory_and_copies_once_where_it_must_cut() {
    let sizes = [(128, 64, 0), (100, 60, 1)];
    for (name, (width, height, copied)) in
        ["pwcnet_fcdn", "raftsmall_fcdn_4"].into_iter().flat_map(|n| sizes.map(|s| (n, s)))
    {
        let mut matcher = named(name);
        let before = matcher.counts();
        let (older, newer) = (frame(width, height, (0.0, 0.0), 1), frame(width, height, (1.0, 1.0), 2));
        let mut lender = Watched::default();
        let address = {
            let flow = matcher.between(&pair(&older, &newer), &mut lender).unwrap();
            assert!(flow.vectors.iter().all(|value| value.is_finite()));
            assert!(flow.vectors.iter().any(|&value| value != 0.0));
            assert!(flow.confidence.iter().all(|value| (0.0..=1.0).contains(value)));
            flow.vectors.as_ptr()
        };
        assert_eq!(lender.lent_at, [address]);
        // ONNX Runtime's own pointer to its output was compared with this memory; a difference would be counted.
        assert_eq!(matcher.counts().copied - before.copied, copied, "{width}x{height}");
    }
}

#[test]
fn threads_stay_on_the_cores_that_are_named() {
    let allowed = cores::allowed();
    let own: Vec<usize> = allowed.iter().rev().take(2).copied().collect();
    let config = Config { threads: own.len(), cores: own.clone(), ..Config::default() };
    let before = threads();
    let mut pinned = Matcher::open(&config).unwrap();
    // Of other tests' threads at the same time none is on a single core.
    let kept: Vec<String> = threads()
        .into_iter()
        .filter(|thread| !before.contains(thread))
        .filter_map(|thread| fs::read_to_string(thread.join("status")).ok())
        .filter_map(|text| Some(text.split("Cpus_allowed_list:").nth(1)?.split_whitespace().next()?.to_owned()))
        .collect();
    // A session each for pyramid and decoder, and the caller is one thread of both.
    let found = kept.iter().filter(|list| own.get(1).is_some_and(|core| **list == core.to_string())).count();
    assert_eq!(found, if own.len() == 2 && allowed.len() > 1 { 2 } else { 0 }, "{kept:?} of {own:?}");
    let (older, newer) = (frame(128, 64, (0.0, 0.0), 1), frame(128, 64, (1.0, 1.0), 2));
    let mut free = Matcher::open(&Config { cores: vec![], ..config }).unwrap();
    let (mut here, mut there) = (Own::default(), Own::default());
    let flow = pinned.between(&pair(&older, &newer), &mut here).unwrap().vectors.to_vec();
    assert_eq!(flow, free.between(&pair(&older, &newer), &mut there).unwrap().vectors);
    assert_eq!(cores::allowed(), allowed, "the caller is where it was");
    let wrong = Config { cores: vec![1023; 2], threads: 2, ..Config::default() };
    let said = Matcher::open(&wrong).map(drop).unwrap_err().to_string();
    assert!(said.starts_with("[flow] cores = [1023, 1023]: 1023 is none that this program may run on"), "{said}");
}

/// The threads of this program.
pub fn threads() -> Vec<PathBuf> {
    fs::read_dir("/proc/self/task").unwrap().map(|entry| entry.unwrap().path()).collect()
}

/// The real-time priorities of the threads that `before` does not name.
pub fn priorities(before: &[PathBuf]) -> Vec<u8> {
    let new = threads().into_iter().filter(|thread| !before.contains(thread));
    // The fortieth of all, and the name, which may hold blanks, is the second.
    let told = new.filter_map(|thread| fs::read_to_string(thread.join("stat")).ok());
    told.filter_map(|text| text.rsplit(") ").next()?.split(' ').nth(37)?.parse().ok()).collect()
}

/// On a thread of its own, for the test's runner is to stay what it is: what was taken goes on to who is started, until that leaves.
fn passes_on(priority: u8) {
    priority::leave();
    priority::take(&Config { priority: 0, ..Config::default() }).unwrap();
    assert_eq!(priority::current(), Policy::Ordinary);
    priority::take(&Config { priority, ..Config::default() }).unwrap();
    let started = || (priority::current(), priority::leave(), priority::current());
    let (inherited, (), left) = thread::spawn(started).join().unwrap();
    assert_eq!((inherited, left), (Policy::RealTime(priority), Policy::Ordinary));
    assert_eq!(priority::current(), Policy::RealTime(priority), "who leaves takes nobody along");
}

#[test]
fn the_networks_threads_have_the_priority_that_is_set_or_the_node_says_why_not() {
    // Nobody else here has this one.
    let config = Config { threads: 2, priority: 7, ..Config::default() };
    let opening = thread::spawn(move || {
        let before = threads();
        match Matcher::open(&config) {
            // A session each for pyramid and decoder, and the caller is one thread of both.
            Ok(_open) => {
                assert_eq!(priorities(&before).iter().filter(|&&priority| priority == 7).count(), 2);
                thread::spawn(|| passes_on(8)).join().unwrap();
            }
            // Who tests may be nobody to whom the system grants it, and is told what would.
            Err(why) => {
                let said = why.to_string();
                assert!(said.contains("[flow] priority = 7: ") && said.contains("LimitRTPRIO=7"), "{said}");
                assert_eq!(priority::current(), Policy::Ordinary);
            }
        }
    });
    opening.join().unwrap();
}

#[test]
fn a_real_network_keeps_features_and_gives_the_same_bits_again() {
    ["pwcnet_fcdn", "raftsmall_fcdn_4"].into_iter().for_each(gives_the_same_bits_again);
}

fn gives_the_same_bits_again(network: &str) {
    let frames: Vec<_> = (1..=4).map(|n| frame(128, 128, (n as f64, -0.5 * n as f64), n)).collect();
    let mut matcher = named(network);
    let mut run = || {
        let mut all = Vec::new();
        for two in frames.windows(2) {
            let mut own = Own::default();
            let flow = matcher.between(&pair(&two[0], &two[1]), &mut own).unwrap();
            all.extend(flow.vectors.iter().chain(flow.confidence).map(|value| value.to_bits()));
        }
        (all, matcher.counts().described)
    };
    let (first, described) = run();
    assert_eq!(described, 4);
    let (second, _) = run();
    assert_eq!(first, second);
    let mut fresh = named(network);
    let mut own = Own::default();
    let flow = fresh.between(&pair(&frames[2], &frames[3]), &mut own).unwrap();
    let last: Vec<u32> = flow.vectors.iter().chain(flow.confidence).map(|value| value.to_bits()).collect();
    assert_eq!(first[first.len() - last.len()..], last, "kept features give what fresh ones give");
}
