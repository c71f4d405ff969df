//! Scenes with exact flow: what the flow says is what the frames show, and the same bytes come from any thread.

use std::{io::Read, path::Path, process::Command};

use nightflow::darkness::{
    flow_files::{self, read_frame},
    recipes::Recipe,
    scenes::{Library, Pair, Part, Preset, Scenes, Settings, stream},
};
use rayon::prelude::*;

const SIZE: [usize; 2] = [320, 240];

fn scenes(preset: Preset, size: [usize; 2]) -> Scenes {
    Scenes::new(Settings { preset, size, seed: 5, recipe: None }, Library::by_formula(3)).unwrap()
}

fn drawn(preset: Preset, size: [usize; 2], count: u64) -> Vec<Pair> {
    let scenes = scenes(preset, size);
    (0..count).into_par_iter().map(|index| scenes.pair(index)).collect()
}

/// Brightness at a pixel, 0…255.
fn grey(frame: &[u8], at: usize) -> f64 {
    frame[3 * at..3 * at + 3].iter().map(|colour| f64::from(*colour)).sum::<f64>() / 3.0
}

/// Brightness between pixels.
fn between(frame: &[u8], [width, height]: [usize; 2], [x, y]: [f64; 2]) -> f64 {
    let (column, row) = ((x as usize).min(width - 2), (y as usize).min(height - 2));
    let (fx, fy) = (x - column as f64, y - row as f64);
    let at = |dx: usize, dy: usize| grey(frame, (row + dy) * width + column + dx);
    (at(0, 0) * (1.0 - fx) + at(1, 0) * fx) * (1.0 - fy) + (at(0, 1) * (1.0 - fx) + at(1, 1) * fx) * fy
}

/// Differences between the older frame and the newer one carried back by the flow, where the point is still seen; and
/// where it is not, but lies inside.
fn carried_back(pair: &Pair) -> [Vec<f64>; 2] {
    let [width, height] = pair.size;
    let mut differences = [Vec::new(), Vec::new()];
    for (at, [u, v]) in pair.flow.iter().enumerate() {
        let to = [(at % width) as f64 + f64::from(*u), (at / width) as f64 + f64::from(*v)];
        let inside = (0.0..=(width - 1) as f64).contains(&to[0]) && (0.0..=(height - 1) as f64).contains(&to[1]);
        assert!(inside || !pair.valid[at], "a point outside is said to be seen");
        if inside {
            let difference = (between(&pair.newer, pair.size, to) - grey(&pair.older, at)).abs();
            differences[usize::from(!pair.valid[at])].push(difference);
        }
    }
    differences
}

fn percentile(values: &mut [f64], part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[((values.len() - 1) as f64 * part) as usize]
}

#[test]
fn the_flow_carries_the_newer_frame_back_onto_the_older() {
    for preset in [Preset::Chairs, Preset::Drone] {
        let [mut seen, mut hidden] = [Vec::new(), Vec::new()];
        for pair in drawn(preset, SIZE, 12) {
            let [a, b] = carried_back(&pair);
            seen.extend(a);
            hidden.extend(b);
        }
        let (median, most) = (percentile(&mut seen, 0.5), percentile(&mut seen, 0.95));
        let covered = percentile(&mut hidden, 0.5);
        println!("{preset}: {median:.2} in the median, {most:.2} at 95 %, {covered:.2} where covered (of 255)");
        assert!(seen.len() > 4 * hidden.len() && hidden.len() > 1000, "{} seen, {} covered", seen.len(), hidden.len());
        // What is left is sampling twice; where something else came before, the difference is that of two pictures.
        assert!(median < 2.0 && most < 14.0, "{preset}: median {median}, 95 % {most}");
        assert!(covered > 8.0 * median, "{preset}: {covered} where covered");
    }
}

/// The displacement that remains between the carried-back frame and the older one, by least squares over the gradient.
#[test]
fn no_part_of_a_pixel_is_left_between_flow_and_frames() {
    let mut sums = [[0.0; 3]; 2];
    for pair in drawn(Preset::Mixed, SIZE, 12) {
        let [width, height] = pair.size;
        for (at, [u, v]) in pair.flow.iter().enumerate().filter(|(at, _)| pair.valid[*at]) {
            let (column, row) = (at % width, at / width);
            if column == 0 || row == 0 || column + 1 == width || row + 1 == height {
                continue;
            }
            let difference =
                between(&pair.newer, pair.size, [column as f64 + f64::from(*u), row as f64 + f64::from(*v)])
                    - grey(&pair.older, at);
            let slopes = [
                (grey(&pair.older, at + 1) - grey(&pair.older, at - 1)) / 2.0,
                (grey(&pair.older, at + width) - grey(&pair.older, at - width)) / 2.0,
            ];
            // Edges of layers and what is half covered are no texture.
            if difference.abs() < 25.0 {
                for axis in 0..2 {
                    sums[axis][0] += slopes[axis] * difference;
                    sums[axis][1] += slopes[axis] * slopes[axis];
                    sums[axis][2] += 1.0;
                }
            }
        }
    }
    for (axis, [product, square, count]) in sums.into_iter().enumerate() {
        let left = product / square;
        println!("axis {axis}: {left:.4} px are left over {count} pixels");
        assert!(count > 200_000.0 && left.abs() < 0.02, "axis {axis}: {left} px over {count} pixels");
    }
}

#[test]
fn displacements_are_those_of_flyingchairs_and_of_a_drone() {
    let lengths = |preset| -> Vec<f64> {
        let pairs = drawn(preset, [448, 320], 60);
        pairs.iter().flat_map(|pair| pair.flow.iter().step_by(7)).map(|[u, v]| f64::from(u.hypot(*v))).collect()
    };
    let mut chairs = lengths(Preset::Chairs);
    let mean = chairs.iter().sum::<f64>() / chairs.len() as f64;
    let [median, ninth, most] = [0.5, 0.9, 0.99].map(|part| percentile(&mut chairs, part));
    println!("chairs: mean {mean:.1}, median {median:.1}, 90 % {ninth:.1}, 99 % {most:.1} px");
    assert!((7.0..18.0).contains(&mean) && (2.0..9.0).contains(&median), "mean {mean}, median {median}");
    assert!((18.0..50.0).contains(&ninth) && (40.0..130.0).contains(&most), "90 % {ninth}, 99 % {most}");
    let mut drone = lengths(Preset::Drone);
    let small = drone.iter().filter(|length| **length < 8.0).count() as f64 / drone.len() as f64;
    let [median, most, end] = [0.5, 0.999, 1.0].map(|part| percentile(&mut drone, part));
    println!("drone: median {median:.1}, 99.9 % {most:.1}, longest {end:.1} px, {:.0} % below 8 px", 100.0 * small);
    assert!(small > 0.6 && (1.5..8.0).contains(&median) && most <= 32.5, "{small} below 8, {median}, {most}");
}

#[test]
fn pairs_do_not_depend_on_threads_or_on_order() {
    let scenes = scenes(Preset::Mixed, [96, 64]);
    let one_by_one: Vec<Pair> = (0..6).rev().map(|index| scenes.pair(index)).collect();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    let together: Vec<Pair> = pool.install(|| (0..6).into_par_iter().map(|index| scenes.pair(index)).collect());
    assert!(one_by_one.iter().rev().eq(&together));
    assert_ne!(together[0].older, together[2].older);
    let other = Scenes::new(Settings { seed: 6, ..*scenes.settings() }, Library::by_formula(3)).unwrap();
    assert_ne!(other.pair(0).older, together[0].older);
}

#[test]
fn noise_is_the_recipes_and_leaves_scene_and_flow_alone() {
    let clean = scenes(Preset::Mixed, [96, 64]);
    let settings = Settings { recipe: Some(Recipe::Paper), ..*clean.settings() };
    let dark = Scenes::new(settings, Library::by_formula(3)).unwrap();
    for index in 0..4 {
        let (mut pair, noisy) = (clean.pair(index), dark.pair(index));
        assert_eq!((&pair.flow, &pair.valid, pair.noise), (&noisy.flow, &noisy.valid, None));
        let drawn = Recipe::Paper.darken(settings.seed, index, &mut pair.older, &mut pair.newer).unwrap();
        assert!(pair.older == noisy.older && pair.newer == noisy.newer && pair.older != pair.newer);
        let grain = noisy.noise.unwrap();
        assert_eq!((grain.a[1], grain.level), (drawn.a[1] as f32, drawn.level as f32));
        let mut record = Vec::new();
        stream::append(&noisy, stream::Precision::Half, &mut record);
        assert_eq!(record.len(), stream::record_bytes([96, 64], stream::Precision::Half));
        assert_eq!(record[32..36], grain.level.to_le_bytes());
    }
}

fn run(args: &[&str]) -> Vec<u8> {
    let done = Command::new(env!("CARGO_BIN_EXE_nightflow")).args(["synth", "scenes"]).args(args).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    done.stdout
}

fn words<const N: usize>(bytes: &[u8], at: usize) -> [u32; N] {
    std::array::from_fn(|i| u32::from_le_bytes(bytes[at + 4 * i..at + 4 * i + 4].try_into().unwrap()))
}

#[test]
fn a_stream_holds_what_the_files_hold() {
    let folder = tempfile::tempdir().unwrap();
    let to = folder.path().to_str().unwrap();
    let what = ["--size", "96x64", "--seed", "9", "--preset", "mixed", "--count", "3"];
    let said = String::from_utf8(run(&[&what[..], &["--to", to]].concat())).unwrap();
    assert!(said.contains("3 pairs drawn, 0 were there"), "{said}");
    std::fs::remove_file(folder.path().join("00002_flow.flo")).unwrap();
    let said = String::from_utf8(run(&[&what[..], &["--to", to, "--threads", "2"]].concat())).unwrap();
    assert!(said.contains("1 pairs drawn, 2 were there"), "{said}");
    let bytes = run(&[&what[..], &["--stream", "--flow", "f32", "--threads", "1"]].concat());
    assert_eq!(bytes, run(&[&what[..], &["--stream", "--flow", "f32", "--threads", "3"]].concat()));
    assert_eq!(&bytes[..8], stream::MAGIC);
    let record = stream::RECORD_HEAD + 96 * 64 * 15;
    assert_eq!(words(&bytes, 8), [1, stream::HEADER as u32, 96, 64, 4, record as u32]);
    assert_eq!(words(&bytes, 32), [9, 0, 0, 0, 3, 0]);
    assert_eq!((&bytes[56..61], &bytes[72..78]), (&b"none\0"[..], &b"mixed\0"[..]));
    assert_eq!(bytes.len(), stream::HEADER + 3 * record);
    for (index, record) in bytes[stream::HEADER..].chunks_exact(record).enumerate() {
        assert_eq!(words(record, 0), [index as u32, 0]);
        let at = |ending: &str| folder.path().join(format!("{:05}_{ending}", index + 1));
        let (frames, rest) = record[stream::RECORD_HEAD..].split_at(2 * 96 * 64 * 3);
        let read = |ending: &str| read_frame(&at(ending)).unwrap().into_raw();
        assert!(frames == [read("img1.ppm"), read("img2.ppm")].concat());
        let (flow, valid) = rest.split_at(96 * 64 * 8);
        let field = flow_files::read(&at("flow.flo")).unwrap();
        let vectors: Vec<u8> = field.vectors.as_flattened().iter().flat_map(|value| value.to_le_bytes()).collect();
        assert!(flow == vectors);
        let mask: Vec<u8> = read("valid.png").iter().step_by(3).map(|value| value / 255).collect();
        assert!(valid == mask);
    }
    let refused = Command::new(env!("CARGO_BIN_EXE_nightflow"))
        .args(["synth", "scenes", "--to", to, "--count", "3", "--seed", "8"])
        .output()
        .unwrap();
    let said = String::from_utf8(refused.stderr).unwrap();
    assert!(!refused.status.success() && said.contains("holds other scenes"), "{said}");
}

#[test]
fn a_stream_waits_for_its_reader_and_ends_with_it() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_nightflow"))
        .args(["synth", "scenes", "--stream", "--size", "64x64"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut some = vec![0; 200_000];
    let mut out = child.stdout.take().unwrap();
    out.read_exact(&mut some).unwrap();
    drop(out);
    let done = child.wait_with_output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

#[test]
fn photographs_and_cutouts_are_split_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let photos = folder.path().join("photos");
    let cutouts = folder.path().join("cutouts");
    std::fs::create_dir_all(&photos).unwrap();
    std::fs::create_dir_all(&cutouts).unwrap();
    for number in 0..30_u8 {
        let image = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([number * 8, (x * 4) as u8, (y * 5) as u8]));
        image.save(photos.join(format!("{number}.png"))).unwrap();
    }
    std::fs::write(photos.join("torn.jpg"), b"\xff\xd8\xff").unwrap();
    let round = |x: u32, y: u32| if (x as i32 - 20).pow(2) + (y as i32 - 20).pow(2) < 300 { 255 } else { 0 };
    let stamp = image::RgbaImage::from_fn(40, 40, |x, y| image::Rgba([200, 30, 30, round(x, y)]));
    stamp.save(cutouts.join("disc.png")).unwrap();
    let read = |part| Library::read(&photos, Some(&cutouts), part).unwrap();
    let all = read(Part::All);
    assert_eq!(all.counts(), [30, 1]);
    assert!(all.left_out.len() == 1 && all.left_out[0].contains("torn.jpg"), "{:?}", all.left_out);
    let [training, held] = [read(Part::Training).counts()[0], read(Part::HeldOut).counts()[0]];
    assert!(training + held == 30 && (1..10).contains(&held), "{training} and {held}");
    let pair =
        Scenes::new(Settings { preset: Preset::Chairs, size: [96, 64], seed: 1, recipe: None }, all).unwrap().pair(0);
    assert_eq!(pair.older.len(), 96 * 64 * 3);
    assert!(Library::read(&cutouts, Some(Path::new(&photos)), Part::All).is_err(), "pictures without transparency fly");
    assert!(
        Scenes::new(Settings { preset: Preset::Chairs, size: [0, 64], seed: 1, recipe: None }, read(Part::All))
            .is_err()
    );
}
