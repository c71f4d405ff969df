//! Evaluation: scores by hand, every layout of data set, the ladder's statistics, enhancers against OpenCV, the bound
//! against a matched filter, and the command from end to end.

mod recipes;

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use nightflow::{
    darkness::{
        bound,
        datasets::{self, Kind},
        enhance::{Enhancer, enhance},
        flow_files::{self, Field},
        ladder::{self, Linear, MEANS, Sensor},
        methods::{self, Enhancing, Method, Shown},
        nlm,
        noise::Normals,
        picture::Picture,
        raws::{self, Mosaic},
        score::{Spread, score},
    },
    flow,
};

use super::{onnx_bytes, peers};

fn uniform(width: usize, height: usize, vector: [f32; 2]) -> Field {
    Field { width, height, vectors: vec![vector; width * height], valid: None }
}

/// Smooth structure of many directions and all tones.
pub fn textured(width: usize, height: usize, seed: u64) -> Picture {
    let mut draws = Normals::new(seed, 0);
    let waves: Vec<[f64; 5]> = (0..24)
        .map(|_| {
            let (angle, length) = (draws.uniform() * 6.3, 5.0 + 25.0 * draws.uniform());
            [angle.cos() / length, angle.sin() / length, draws.uniform(), draws.uniform() * 3.0, draws.uniform()]
        })
        .collect();
    let mut rgb = Vec::new();
    for y in 0..height {
        for x in 0..width {
            for c in 0..3 {
                let wave = |w: &[f64; 5]| {
                    (std::f64::consts::TAU * (w[0] * x as f64 + w[1] * y as f64 + w[2]) + w[3] * f64::from(c)).sin()
                        * w[4]
                };
                rgb.push((118.0 + 22.0 * waves.iter().map(wave).sum::<f64>()).clamp(0.0, 255.0) as u8);
            }
        }
    }
    Picture { width, height, rgb }
}

#[test]
fn scores_are_those_computed_by_hand() {
    let truth = Field {
        width: 4,
        height: 1,
        vectors: vec![[3.0, 4.0], [100.0, 0.0], [0.0, 0.0], [7.0, 7.0]],
        valid: Some(vec![true, true, true, false]),
    };
    let found =
        Field { vectors: vec![[3.0, 0.0], [104.0, 0.0], [0.0, 1.0], [f32::NAN; 2]], valid: None, ..truth.clone() };
    let got = score(&found, &truth).unwrap();
    // Errors 4, 4 and 1. The first is above 3 px and 5 %, the second above 3 px but only 4 %.
    assert!((got.epe - 3.0).abs() < 1e-9, "{got:?}");
    assert!((got.fl_all - 1.0 / 3.0).abs() < 1e-9, "{got:?}");
    // cos = (3·3 + 0·4 + 1) / √(9 + 1) / √(25 + 1), and (100·104 + 1) / √10001 / √10817, and 1 / √2.
    let angles = [(10.0 / (10.0f64 * 26.0).sqrt()), 10401.0 / (10001.0f64 * 10817.0).sqrt(), 0.5f64.sqrt()];
    let want = angles.iter().map(|cosine| cosine.acos().to_degrees()).sum::<f64>() / 3.0;
    assert!((got.aae - want).abs() < 1e-6, "{got:?} {want}");
    // What is not known counts as zero flow.
    let silent = Field { vectors: vec![[f32::NAN; 2]; 4], ..found.clone() };
    assert!((score(&silent, &truth).unwrap().epe - 35.0).abs() < 1e-9);
    assert_eq!(score(&uniform(2, 2, [0.0; 2]), &truth), None, "another size");
    assert_eq!(score(&found, &Field { valid: Some(vec![false; 4]), ..truth }), None, "nothing is known");
    let spread = Spread::of(&[1.0, 2.0, 3.0]).unwrap();
    assert_eq!((spread.mean, spread.count), (2.0, 3));
    assert!((spread.error - (1.0f64 / 3.0).sqrt()).abs() < 1e-12);
}

/// Writes a frame and makes its folders.
pub fn frame(path: PathBuf) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    textured(24, 16, 3).write(&path).unwrap();
}

pub fn truth(path: PathBuf) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    flow_files::write(&path, &uniform(24, 16, [1.5, -2.0])).unwrap();
}

/// What is found in a folder, loaded: kind, names with conditions, and what was left out.
fn found(root: &Path) -> (Kind, Vec<String>, Vec<String>) {
    let found = datasets::find(root, None).unwrap();
    let (mut whole, mut left) = (vec![], found.skipped);
    for item in &found.items {
        match datasets::load(item) {
            Ok(loaded) => {
                for (condition, truth) in &loaded.truths {
                    let mean = score(&uniform(24, 16, [1.5, -2.0]), truth).unwrap().epe;
                    assert!(mean < 0.01, "{}: {mean}", item.name);
                    whole.push(format!("{} {condition}", item.name));
                }
            }
            Err(skipped) => left.push(skipped),
        }
    }
    (found.kind, whole, left.into_iter().map(|left| format!("{}: {}", left.what, left.why)).collect())
}

#[test]
fn pairs_and_vbof_are_found_and_what_lacks_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("chairs");
    for name in ["00001", "00002", "00003", "00004"] {
        frame(root.join(format!("{name}_img1.ppm")));
        frame(root.join(format!("{name}_img2.ppm")));
        truth(root.join(format!("{name}_flow.flo")));
    }
    fs::remove_file(root.join("00002_img2.ppm")).unwrap();
    let whole = fs::read(root.join("00003_flow.flo")).unwrap();
    fs::write(root.join("00003_flow.flo"), &whole[..whole.len() - 5]).unwrap();
    let (kind, items, left) = found(&root);
    assert_eq!((kind, items), (Kind::Pairs, vec!["00001 all".to_owned(), "00004 all".to_owned()]));
    assert_eq!(left.len(), 2, "{left:?}");
    assert!(left[0].contains("00002_img2") && left[1].contains("00003_flow.flo") && left[1].contains("expected"));

    let root = dir.path().join("vbof");
    for name in ["01020301", "01020304", "03010205"] {
        frame(root.join(format!("{name}_img1.png")));
        frame(root.join(format!("{name}_img2.png")));
    }
    // The flow of the bright pair is that of the dark one from the same two places.
    truth(root.join("01020301_flow.flo"));
    let (kind, items, left) = found(&root);
    assert_eq!(kind, Kind::Vbof);
    assert_eq!(items, ["01020301 exposure 1", "01020304 exposure 4"]);
    assert!(left.len() == 1 && left[0].contains("03010205_flow.flo"), "{left:?}");
    assert!(datasets::find(&dir.path().join("nowhere"), None).unwrap_err().to_string().contains("nowhere"));
    let said = datasets::find(dir.path(), None).unwrap_err().to_string();
    assert!(said.contains("expected CCPPQQEE_img1") && said.contains("chairs"), "{said}");
}

#[test]
fn middlebury_sintel_and_kitti_are_found() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("apart");
    for file in ["other-data/Venus/frame10.png", "other-data/Venus/frame11.png", "other-data/Beanbags/frame10.png"] {
        frame(root.join(file));
    }
    truth(root.join("other-gt-flow/Venus/flow10.flo"));
    truth(root.join("other-gt-flow/Hydrangea/flow10.flo"));
    let (kind, items, left) = found(&root);
    assert_eq!((kind, items), (Kind::Middlebury, vec!["Venus all".to_owned()]));
    assert!(left.len() == 1 && left[0].contains("Hydrangea"), "{left:?}");
    let root = dir.path().join("together");
    for file in ["frame10.png", "frame11.png"] {
        frame(root.join("Venus").join(file));
    }
    truth(root.join("Venus/flow10.flo"));
    assert_eq!(found(&root).1, ["Venus all"]);

    let root = dir.path().join("sintel/training");
    for pass in ["clean", "final"] {
        (1..=3).for_each(|i| frame(root.join(format!("{pass}/alley_1/frame_000{i}.png"))));
    }
    (1..=2).for_each(|i| truth(root.join(format!("flow/alley_1/frame_000{i}.flo"))));
    fs::remove_file(root.join("final/alley_1/frame_0003.png")).unwrap();
    let (kind, items, left) = found(&dir.path().join("sintel"));
    assert_eq!(kind, Kind::Sintel);
    assert_eq!(items, ["clean_alley_1_0001 clean", "clean_alley_1_0002 clean", "final_alley_1_0001 final"]);
    assert!(left.len() == 1 && left[0].contains("frame_0003.png"), "{left:?}");

    for colour in ["image_2", "colored_0"] {
        let root = dir.path().join(colour);
        for file in ["000000_10.png", "000000_11.png", "000001_10.png", "000001_11.png"] {
            frame(root.join("training").join(colour).join(file));
        }
        for set in ["flow_occ", "flow_noc"] {
            truth(root.join("training").join(set).join("000000_10.png"));
            truth(root.join("training").join(set).join("000001_10.png"));
        }
        // A picture of colours where 16-bit flow should be.
        frame(root.join("training/flow_noc/000001_10.png"));
        let (kind, items, left) = found(&root);
        assert_eq!((kind, items), (Kind::Kitti, vec!["000000 occ".to_owned(), "000000 noc".to_owned()]));
        assert!(left.len() == 1 && left[0].contains("000001") && left[0].contains("expected"), "{left:?}");
    }
}

#[test]
fn the_ladder_has_the_mean_and_the_variance_that_it_promises() {
    let (width, height) = (256, 192);
    let byte = 150u8;
    let grey = Picture { width, height, rgb: vec![byte; 3 * width * height] };
    assert!((ladder::light(188) - 0.5029).abs() < 1e-3 && ladder::light(10) < 0.0031);
    let linear = Linear::of([&grey, &grey]);
    let sensor = Sensor::find("Canon EOS M6", 3200).unwrap();
    assert_eq!((sensor.black, sensor.white), (2047.0, 16383.0));
    for (at, mean) in MEANS.into_iter().enumerate().take(5) {
        let rung = linear.expose(&sensor, mean, 5, "grey");
        assert!((rung.gain * mean / 0.4 - 1.0).abs() < 0.01, "Exp-{at}: {}", rung.gain);
        for (c, frame) in [0, 1, 2].into_iter().flat_map(|c| rung.scaled.iter().map(move |frame| (c, frame))) {
            let values: Vec<f64> = frame.iter().skip(c).step_by(3).map(|value| f64::from(*value)).collect();
            let count = values.len() as f64;
            let found = values.iter().sum::<f64>() / count;
            let variance = values.iter().map(|value| (value - found).powi(2)).sum::<f64>() / (count - 1.0);
            let span = 16383.0 - 2047.0;
            // r·a·y + r²·b + quantisation of a count, by the profile's own figures.
            let r = 0.4 / mean;
            let want = r * sensor.noise.a[c] * 0.4 + r * r * sensor.noise.b[c] + (r / span).powi(2) / 12.0;
            // Five deviations of a mean and of a variance of so many draws.
            assert!((found - 0.4).abs() < 5.0 * (want / count).sqrt() + 1e-4, "Exp-{at} {c}: {found}");
            assert!((variance / want - 1.0).abs() < 0.04, "Exp-{at} colour {c}: {variance:e}, expected {want:e}");
            let promised = rung.variance(c, 0.4) - 1.0 / (12.0 * 255.0 * 255.0);
            assert!((promised / want - 1.0).abs() < 0.02, "Exp-{at} {c}: {promised:e} {want:e}");
        }
    }
    // In the deepest dark values are clipped at both ends, and the mean of a picture is still near what it should be.
    let darkest = linear.expose(&sensor, MEANS[6], 5, "grey");
    let mean = darkest.scaled[0].iter().map(|value| f64::from(*value)).sum::<f64>() / (3 * width * height) as f64;
    assert!((mean - 0.4).abs() < 0.03, "{mean}");
    assert!(darkest.scaled[0].contains(&0.0) && darkest.scaled[0].contains(&1.0));
}

#[test]
fn a_seed_gives_the_same_bits_on_any_number_of_threads() {
    let pair = [textured(96, 64, 1), textured(96, 64, 2)];
    let sensor = Sensor::find("Sony ILCE-6000", 1600).unwrap();
    let drawn = |threads: usize, seed: u64, name: &str| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| Linear::of([&pair[0], &pair[1]]).expose(&sensor, 0.004, seed, name).pictures())
    };
    let first = drawn(1, 9, "a");
    assert_eq!(first, drawn(3, 9, "a"));
    assert_ne!(first, drawn(1, 10, "a"));
    assert_ne!(first, drawn(1, 9, "b"));
    assert_ne!(first[0], first[1]);
    let by = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| enhance(&Enhancer::Nlm, &first[0]).unwrap())
    };
    assert_eq!(by(1), by(3));
}

/// The displacement that the matched filter finds in the middle of a rung: least squares with the known gradients and
/// variances, which is efficient, so that its spread is the bound.
fn registered(rung: &ladder::Rung, centre: usize, half: usize) -> [f64; 2] {
    let w = rung.width;
    let (mut xx, mut xy, mut yy, mut x, mut y) = (0.0, 0.0, 0.0, 0.0, 0.0);
    let clean = |x: usize, y: usize, c: usize| f64::from(rung.clean[(y * w + x) * 3 + c]);
    let slope = |far: f64, near: f64, next: f64, last: f64| (8.0 * (next - near) - (last - far)) / 12.0;
    for row in centre - half..=centre + half {
        for col in centre - half..=centre + half {
            for c in 0..3 {
                let at = |i: isize| (col as isize + i) as usize;
                let down = |i: isize| (row as isize + i) as usize;
                let ix =
                    slope(clean(at(-2), row, c), clean(at(-1), row, c), clean(at(1), row, c), clean(at(2), row, c));
                let iy = slope(
                    clean(col, down(-2), c),
                    clean(col, down(-1), c),
                    clean(col, down(1), c),
                    clean(col, down(2), c),
                );
                let i = (row * w + col) * 3 + c;
                let change = f64::from(rung.scaled[1][i]) - f64::from(rung.scaled[0][i]);
                let weight = 1.0 / rung.variance(c, clean(col, row, c));
                (xx, xy, yy) = (xx + weight * ix * ix, xy + weight * ix * iy, yy + weight * iy * iy);
                (x, y) = (x - weight * ix * change, y - weight * iy * change);
            }
        }
    }
    let determinant = xx * yy - xy * xy;
    [(yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant]
}

#[test]
fn the_bound_is_what_a_matched_filter_reaches() {
    let side = 48;
    // Of little contrast: where a pixel saturates the filter, which doesn't know of it, would take its lack of change for
    // a lack of motion, and be right.
    let mut picture = textured(side, side, 7);
    picture.rgb.iter_mut().for_each(|byte| *byte = 90 + *byte / 4);
    let linear = Linear::of([&picture, &picture]);
    let sensor = Sensor::find("Canon EOS M6", 3200).unwrap();
    for mean in [0.03, 0.01] {
        // Nothing is known beforehand: a wide prior, and one pixel in the middle that counts.
        let mut truth = uniform(side, side, [1000.0, 1000.0]);
        let mut valid = vec![false; side * side];
        valid[24 * side + 24] = true;
        truth.valid = Some(valid);
        let rung = linear.expose(&sensor, mean, 0, "patch");
        let limit = bound::limit(&rung, &truth, 15).unwrap();
        let draws: Vec<[f64; 2]> =
            (1..=400).map(|seed| registered(&linear.expose(&sensor, mean, seed, "patch"), 24, 7)).collect();
        let count = draws.len() as f64;
        let rms = (draws.iter().map(|[x, y]| x * x + y * y).sum::<f64>() / count).sqrt();
        let epe = draws.iter().map(|[x, y]| x.hypot(*y)).sum::<f64>() / count;
        println!("mean {mean}: matched filter {rms:.4} px rms, {epe:.4} px; bound {:.4}, {:.4}", limit.rms, limit.epe);
        // 400 draws know a deviation to 2.5 %; clipping and 8-bit rounding, which the filter doesn't see, to a hair.
        assert!((rms / limit.rms - 1.0).abs() < 0.1, "{mean}: {rms} against {limit:?}");
        assert!((epe / limit.epe - 1.0).abs() < 0.1, "{mean}: {epe} against {limit:?}");
    }
    // Darker is harder, and a flat picture is bounded by the scene's own motion: a normal error of s on each axis.
    let flat = Picture { width: side, height: side, rgb: vec![128; 3 * side * side] };
    let rung = Linear::of([&flat, &flat]).expose(&sensor, 0.01, 0, "flat");
    let limit = bound::limit(&rung, &uniform(side, side, [3.0, 4.0]), 15).unwrap();
    assert!((limit.rms - 5.0).abs() < 1e-6, "{limit:?}");
}

#[test]
fn enhancers_are_those_of_opencv() {
    let dir = tempfile::tempdir().unwrap();
    let picture = textured(150, 110, 4);
    let sensor = Sensor::find("Canon EOS M6", 3200).unwrap();
    let noisy = Linear::of([&picture, &picture]).expose(&sensor, 0.01, 2, "cv").pictures()[0].clone();
    let source = dir.path().join("noisy.png");
    noisy.write(&source).unwrap();
    peers::run("enhance.py", [&source, &dir.path().to_path_buf()]);
    let theirs = |name: &str| Picture::from(flow_files::read_frame(&dir.path().join(name)).unwrap());
    let apart = |ours: &[u8], theirs: &[u8]| {
        let apart: Vec<u8> = ours.iter().zip(theirs).map(|(a, b)| a.abs_diff(*b)).collect();
        let mean = apart.iter().map(|value| f64::from(*value)).sum::<f64>() / apart.len() as f64;
        (apart.into_iter().max().unwrap(), mean)
    };
    assert_eq!(enhance(&"median:5".parse().unwrap(), &noisy).unwrap(), theirs("median.png"));
    // The core of non-local means is the same to the bit.
    let green: Vec<u8> = noisy.rgb.iter().skip(1).step_by(3).copied().collect();
    let [ours] = nlm::denoise([&green], noisy.width, noisy.height, 10.0, &nlm::Settings::default());
    let grey: Vec<u8> = theirs("grey.png").rgb.iter().skip(1).step_by(3).copied().collect();
    assert_eq!(ours, grey);
    // With the way to Lab and back it is off by its rounding.
    let (most, mean) = apart(&enhance(&Enhancer::Nlm, &noisy).unwrap().rgb, &theirs("nlm.png").rgb);
    println!("coloured non-local means: at most {most}/255 apart, {mean:.4}/255 in the mean");
    assert!(most <= 2 && mean < 0.1, "{most} {mean}");
    let (most, mean) = apart(&enhance(&Enhancer::Gaussian(2.0), &noisy).unwrap().rgb, &theirs("gaussian.png").rgb);
    println!("Gaussian blur: at most {most}/255 apart, {mean:.4}/255 in the mean");
    // Its kernel is told in 256ths.
    assert!(most <= 1 && mean < 0.2, "{most} {mean}");
    for wrong in ["blur", "median:4", "gaussian:0", "onnx:", "none:1"] {
        let said = wrong.parse::<Enhancer>().unwrap_err().to_string();
        assert!(said.contains("expected none, nlm"), "{said}");
    }
}

#[test]
fn raws_are_binned_by_their_pattern_and_scaled_by_one_gain() {
    // R 1000, G 3000, B 500 above black, on the patterns of both kinds of camera.
    let bayer = [0, 1, 1, 2];
    let trans = b"GBGGRGRGRBGBGBGGRGGRGGBGBGBRGRGRGGBG".map(|letter| match letter {
        b'R' => 0,
        b'G' => 1,
        _ => 2,
    });
    for (period, colours) in [(2usize, bayer.to_vec()), (6, trans.to_vec())] {
        let (width, height) = (36, 24);
        let value = |at: usize| {
            let colour = colours[at / width % period * period + at % width % period];
            1022 + [1000, 3000, 500][usize::from(colour)] as u16
        };
        let counts = (0..width * height).map(value).collect();
        let mosaic = Mosaic { width, height, counts, black: 1022.0, white: 16383.0, period, colours };
        let binned = mosaic.binned().unwrap();
        let side = if period == 2 { 2 } else { 3 };
        assert_eq!((binned.width, binned.height), (width / side, height / side));
        for pixel in binned.rgb.chunks_exact(3) {
            for (value, want) in pixel.iter().zip([1000.0, 3000.0, 500.0]) {
                assert!((f64::from(*value) * 15361.0 - want).abs() < 0.01, "{value} {want}");
            }
        }
        let dimmer =
            Mosaic { counts: mosaic.counts.iter().map(|count| 1022 + (count - 1022) / 2).collect(), ..mosaic.clone() };
        let [first, second] = raws::scaled([&mosaic, &dimmer], (5, 4)).unwrap();
        assert_eq!((first.width, first.height), (5, 4));
        // Mean of both 0.4: 1500 · (1 + 1/2) / 2 becomes 102; the dimmer one stays half as bright.
        let scale = 102.0f64 / 1125.0;
        for (picture, part) in [(first, 1.0f64), (second, 0.5)] {
            for (byte, light) in picture.rgb.iter().zip([1000.0, 3000.0, 500.0].into_iter().cycle()) {
                assert!((f64::from(*byte) - (light * part * scale).min(255.0)).abs() <= 0.51, "{byte} {light}");
            }
        }
        assert!(raws::scaled([&mosaic, &dimmer], (50, 40)).unwrap_err().to_string().contains("smaller"));
    }
}

#[test]
fn anybodys_graph_is_a_method_or_an_enhancer() {
    let dir = tempfile::tempdir().unwrap();
    let [full, quarter, single] = ["full", "quarter", "single"].map(|name| dir.path().join(format!("{name}.onnx")));
    fs::write(&full, onnx_bytes::difference(None)).unwrap();
    fs::write(&quarter, onnx_bytes::difference(Some(4))).unwrap();
    fs::write(&single, onnx_bytes::halved()).unwrap();
    let config = flow::Config::default();
    let plain = |rgb: [u8; 3]| Picture { width: 70, height: 40, rgb: rgb.repeat(70 * 40) };
    let (older, newer) = (plain([30, 20, 10]), plain([27, 22, 10]));
    let shown = Shown { frames: [&older, &newer], place: Path::new("none/all/x_flow.flo") };
    for (given, scale) in [
        (format!("a={}", full.display()), 1.0),
        (format!("b={}", quarter.display()), 1.0),
        (format!("c={}@1", full.display()), 1.0 / 255.0),
    ] {
        let field = Method::open(&given, &config).unwrap().flow(&shown).unwrap();
        assert_eq!((field.width, field.height, field.vectors.len()), (70, 40, 2800));
        let fits = |[u, v]: &[f32; 2]| (u - 3.0 * scale).abs() < 1e-5 && (v + 2.0 * scale).abs() < 1e-5;
        assert!(field.vectors.iter().all(fits), "{given}: {:?}", field.vectors[0]);
    }
    let mut halving = Enhancing::open(Enhancer::Onnx(single.clone()), &config).unwrap();
    assert_eq!(halving.enhance(&plain([200, 100, 50])).unwrap(), plain([100, 50, 25]));
    let refused = |given: &str| Method::open(given, &config).map(|_| ()).unwrap_err();
    assert!(refused(&format!("d={}", single.display())).to_string().contains("expected 2 inputs"));
    assert!(matches!(refused("e=nowhere"), methods::Error::Unknown { .. }));
    let said = refused("no_such_network").to_string();
    assert!(said.contains("no_such_network is not in it") && said.contains("pwcnet_fcdn"), "{said}");
}

#[test]
fn the_command_judges_names_what_is_torn_and_counts() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("pairs");
    for name in ["a", "b", "c"] {
        frame(root.join(format!("{name}_img1.png")));
        frame(root.join(format!("{name}_img2.png")));
        truth(root.join(format!("{name}_flow.flo")));
    }
    fs::write(root.join("b_img2.png"), b"torn").unwrap();
    let nightflow = |args: &[&str]| Command::new(env!("CARGO_BIN_EXE_nightflow")).args(args).output().unwrap();
    let [pairs, dark, other, out] =
        ["pairs", "dark", "other", "out"].map(|name| dir.path().join(name).display().to_string());
    let written =
        nightflow(&["eval", "ladder", &pairs, "--models", "zero", "--enhancers", "none,median", "--write", &dark]);
    assert_eq!(written.status.code(), Some(3), "{}", String::from_utf8_lossy(&written.stderr));
    for file in ["none/Exp-0/a_img1.png", "none/Exp-6/c_img2.png", "median:5/Exp-3/a_img2.png"] {
        assert!(dir.path().join("dark").join(file).exists(), "{file}");
    }
    // Another program finds the truth for every exposure but one, and tears one file.
    for exposure in 0..7 {
        for name in ["a", "c"] {
            truth(dir.path().join(format!("other/none/Exp-{exposure}/{name}_flow.flo")));
        }
    }
    fs::write(dir.path().join("other/none/Exp-2/c_flow.flo"), b"PIEH").unwrap();
    let models = format!("zero,other={other}");
    let judged =
        nightflow(&["eval", "ladder", &pairs, "--models", &models, "--enhancers", "none,median", "--out", &out]);
    assert_eq!(judged.status.code(), Some(3));
    let text = String::from_utf8(judged.stdout).unwrap();
    assert!(text.contains("| | zero | other | limit, mean"), "{text}");
    assert!(text.contains("Left out: 2") && text.contains("b_img2.png") && text.contains("c_flow.flo"), "{text}");
    let table: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(dir.path().join("out/table.json")).unwrap()).unwrap();
    let records = table["records"].as_array().unwrap();
    let of = |model: &'static str| {
        records.iter().filter(move |record| record["model"] == model && record["enhancer"] == "none")
    };
    assert_eq!((of("zero").count(), of("other").count()), (14, 13));
    assert!(of("zero").all(|record| (record["epe"].as_f64().unwrap() - 2.5).abs() < 1e-6));
    assert!(of("other").all(|record| record["epe"].as_f64().unwrap() < 1e-6));
    assert_eq!(table["limits"].as_array().unwrap().len(), 14);
    let csv = fs::read_to_string(dir.path().join("out/table.csv")).unwrap();
    assert!(csv.contains("Exp-2,other,1,") && csv.contains("Exp-3,other,2,"), "{csv}");
    assert!(fs::read_to_string(dir.path().join("out/table.md")).unwrap() == text);
    assert!(fs::read_to_string(dir.path().join("out/epe.svg")).unwrap().contains("Exp-6"));
    // More draws of the noise are no more pairs.
    let drawn =
        nightflow(&["eval", "ladder", &pairs, "--models", "zero", "--only", "a", "--draws", "3", "--write", &dark]);
    let text = String::from_utf8(drawn.stdout).unwrap();
    assert!(text.contains("| 2.50 [1] |") && text.contains("draws a pair: 3"), "{text}");
    let bytes = |file: &str| fs::read(dir.path().join("dark/none/Exp-4").join(file)).unwrap();
    assert_ne!(bytes("a~1_img1.png"), bytes("a~2_img1.png"));
    // As they are, the pairs are known in one light only.
    let plain = nightflow(&["eval", &pairs, "--models", "zero", "--only", "a"]);
    assert_eq!(plain.status.code(), Some(0), "{}", String::from_utf8_lossy(&plain.stderr));
    assert!(String::from_utf8(plain.stdout).unwrap().contains("| all | 2.50 [1] |"));
    let wrong = nightflow(&["eval", "ladder", &pairs, "--camera", "Brownie"]);
    let said = String::from_utf8(wrong.stderr).unwrap();
    assert!(!wrong.status.success() && said.contains("Canon EOS M6"), "{said}");
}
