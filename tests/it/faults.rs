//! Other noise than networks are trained on: the statistics of each kind, its bits, and the table of how error moves.

use std::{fs, process::Command};

use nightflow::darkness::{
    faults::{BAND, FAULTS, Fault, QUALITY, STRENGTH},
    ladder::{Linear, Rung, Sensor},
    noise::Noise,
    picture::Picture,
};

use super::{eval, onnx_bytes};

const WIDTH: usize = 256;
const HEIGHT: usize = 256;
/// Exp-2: the noise is far from both ends of the scaled range.
const MEAN: f64 = 0.03;
/// Counts between black and white of the camera.
const SPAN: f64 = 16383.0 - 2047.0;

fn camera(fault: Fault) -> Sensor {
    Sensor { fault, ..Sensor::find("Canon EOS M6", 3200).unwrap() }
}

fn flat(sensor: &Sensor, mean: f64, name: &str) -> Rung {
    let grey = Picture { width: WIDTH, height: HEIGHT, rgb: vec![150; 3 * WIDTH * HEIGHT] };
    Linear::of([&grey, &grey]).expose(sensor, mean, 5, name)
}

/// What a fault has added to each raw value of both frames, to within the rounding of two counts.
fn added(fault: Fault, name: &str) -> [Vec<f64>; 2] {
    let (with, without) = (flat(&camera(fault), MEAN, name), flat(&camera(Fault::None), MEAN, name));
    [0, 1].map(|frame| {
        let both = with.scaled[frame].iter().zip(&without.scaled[frame]);
        both.map(|(more, less)| f64::from(*more) / with.gain - f64::from(*less) / without.gain).collect()
    })
}

/// The deviation that a fault is to have.
fn wanted() -> f64 {
    STRENGTH * camera(Fault::None).noise.variance(1, MEAN).sqrt()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The central moment of this power.
fn moment(values: &[f64], power: i32) -> f64 {
    let middle = mean(values);
    mean(&values.iter().map(|value| (value - middle).powi(power)).collect::<Vec<_>>())
}

fn correlation(one: &[f64], other: &[f64]) -> f64 {
    let (a, b) = (mean(one), mean(other));
    let both = mean(&one.iter().zip(other).map(|(x, y)| (x - a) * (y - b)).collect::<Vec<_>>());
    both / (moment(one, 2) * moment(other, 2)).sqrt()
}

fn by_row(values: &[f64]) -> Vec<f64> {
    values.chunks_exact(3 * WIDTH).map(mean).collect()
}

fn by_column(values: &[f64]) -> Vec<f64> {
    (0..WIDTH)
        .map(|x| mean(&values.chunks_exact(3 * WIDTH).flat_map(|row| row[3 * x..][..3].to_vec()).collect::<Vec<_>>()))
        .collect()
}

#[test]
fn rows_are_offset_in_each_frame_anew() {
    let frames = added(Fault::Rows, "grey");
    let rows = frames.each_ref().map(|values| by_row(values));
    for (values, rows) in frames.iter().zip(&rows) {
        let deviation = moment(rows, 2).sqrt();
        // 256 draws know a deviation to 4.4 %.
        assert!((deviation / wanted() - 1.0).abs() < 0.15, "{deviation:e}, wanted {:e}", wanted());
        // Beside the rounding a row has one offset.
        for (line, offset) in values.chunks_exact(3 * WIDTH).zip(rows) {
            assert!(line.iter().all(|value| (value - offset).abs() < 1.6 / SPAN));
        }
    }
    assert!(correlation(&rows[0], &rows[1]).abs() < 0.25);
    assert!(correlation(&rows[0][1..], &rows[0][..HEIGHT - 1]).abs() < 0.25);
}

#[test]
fn bands_come_again_and_drift() {
    for name in ["a", "b", "c"] {
        let rows = added(Fault::Banding, name).map(|values| by_row(&values));
        let phases = rows.each_ref().map(|rows| {
            let deviation = moment(rows, 2).sqrt();
            assert!((deviation / wanted() - 1.0).abs() < 0.02, "{deviation:e}, wanted {:e}", wanted());
            let waves = |count: f64| {
                let turn = |row: usize| std::f64::consts::TAU * count * row as f64 / HEIGHT as f64;
                let along = |of: fn(f64) -> f64| {
                    mean(&rows.iter().enumerate().map(|(row, value)| 2.0 * value * of(turn(row))).collect::<Vec<_>>())
                };
                (along(f64::sin), along(f64::cos))
            };
            let (sine, cosine) = waves(HEIGHT as f64 / BAND);
            assert!(sine.hypot(cosine) / 2f64.sqrt() > 0.99 * deviation);
            for other in [1.0, 2.0, 3.0, 5.0, 8.0, 16.0] {
                let (sine, cosine) = waves(other);
                assert!(sine.hypot(cosine) < 0.05 * deviation, "{other} waves");
            }
            cosine.atan2(sine)
        });
        println!("{name}: from {:.2} to {:.2}", phases[0], phases[1]);
        assert!((phases[0] - phases[1]).abs() > 0.05, "{name} does not drift: {phases:?}");
    }
}

#[test]
fn a_fixed_pattern_is_the_same_in_both_frames() {
    let [older, newer] = added(Fault::Fixed, "grey");
    // Each is known to within its rounding, 2/12 of a count squared.
    let apart: Vec<f64> = older.iter().zip(&newer).map(|(a, b)| (a - b) * SPAN).collect();
    assert!(apart.iter().all(|counts| counts.abs() < 4.0));
    assert!((moment(&apart, 2) - 4.0 / 12.0).abs() < 0.02, "{}", moment(&apart, 2));
    let deviation = (moment(&older, 2) - 2.0 / 12.0 / SPAN / SPAN).sqrt();
    assert!((deviation / wanted() - 1.0).abs() < 0.06, "{deviation:e}, wanted {:e}", wanted());
    // Half of the variance is the columns', the rest has no order, neither of rows nor of colours.
    let columns = by_column(&older);
    let part = moment(&columns, 2) / moment(&older, 2);
    assert!((part - 0.5).abs() < 0.1, "{part}");
    let rest: Vec<f64> = older.iter().enumerate().map(|(at, value)| value - columns[at / 3 % WIDTH]).collect();
    assert!(correlation(&rest[1..], &rest[..rest.len() - 1]).abs() < 0.01);
    assert!(correlation(&rest[3..], &rest[..rest.len() - 3]).abs() < 0.01);
    assert!(moment(&by_row(&older), 2).sqrt() < 0.1 * wanted());
    let [other, _] = added(Fault::Fixed, "another camera");
    assert!(correlation(&older, &other).abs() < 0.02 + 4.0 * 0.5 / 16.0);
}

#[test]
fn tukeys_tails_are_long_and_his_variance_is_the_cameras() {
    let noise = Noise { a: [0.0; 3], b: [4e-6, 6e-6, 8e-6] };
    for (fault, kurtosis) in [(Fault::None, 2.95..3.05), (Fault::Tukey, 5.5..8.5)] {
        let rung = flat(&Sensor { noise, ..camera(fault) }, 0.1, "grey");
        let values = rung.scaled.concat();
        for (colour, b) in noise.b.into_iter().enumerate() {
            let values: Vec<f64> =
                values.iter().skip(colour).step_by(3).map(|value| f64::from(*value) / rung.gain).collect();
            let variance = moment(&values, 2);
            let found = moment(&values, 4) / variance.powi(2);
            println!("{fault} {colour}: variance {:.4} of the camera's, kurtosis {found:.2}", variance / b);
            assert!((variance / b - 1.0).abs() < 0.04 && kurtosis.contains(&found), "{fault}: {variance:e} {found}");
            assert!((mean(&values) / 0.1 - 1.0).abs() < 1e-3);
        }
    }
    // Shot noise is no matter of the reading: without any read noise there is nothing to change.
    let silent = |fault| Sensor { noise: Noise { b: [0.0; 3], ..camera(fault).noise }, ..camera(fault) };
    assert_eq!(flat(&silent(Fault::Tukey), MEAN, "x").scaled, flat(&silent(Fault::None), MEAN, "x").scaled);
}

#[test]
fn ten_bits_have_a_sixteenth_of_the_levels() {
    let levels = |fault| {
        let rung = flat(&camera(fault), 0.1, "grey");
        let counts = rung.scaled.concat().into_iter();
        let mut counts: Vec<i64> =
            counts.map(|value| (f64::from(value) / rung.gain * SPAN + 2047.0).round() as i64).collect();
        counts.sort_unstable();
        counts.dedup();
        counts
    };
    let (fine, coarse) = (levels(Fault::None), levels(Fault::TenBit));
    assert!(coarse.iter().all(|count| count % 16 == 0), "{coarse:?}");
    let ratio = fine.len() as f64 / coarse.len() as f64;
    assert!((12.0..17.0).contains(&ratio), "{} levels, {}", fine.len(), coarse.len());
    let [wide, narrow] = [Fault::TenBit, Fault::None].map(|fault| flat(&camera(fault), MEAN, "grey"));
    assert!((wide.step / narrow.step / 16.0 - 1.0).abs() < 1e-3);
    // Nothing is brighter than ten bits can tell.
    let grey = Picture { width: 8, height: 8, rgb: vec![200; 192] };
    let bright = Linear::of([&grey, &grey]).expose(&camera(Fault::TenBit), 2.0, 1, "white");
    let most = (16.0 * 1023.0 - 2047.0) / SPAN * bright.gain;
    assert!(bright.scaled[0].iter().all(|value| f64::from(*value) <= most + 1e-6));
}

#[test]
fn a_preview_has_been_through_a_jpeg() {
    let picture = eval::textured(70, 50, 3);
    let shown = Fault::Jpeg.shown(picture.clone()).unwrap();
    assert_eq!((shown.width, shown.height), (70, 50));
    assert_eq!(shown, picture.through_jpeg(QUALITY).unwrap());
    let apart = |other: &Picture| {
        let squares = picture.rgb.iter().zip(&other.rgb).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
        mean(&squares.collect::<Vec<_>>()).sqrt()
    };
    println!("off by {:.2} of 255", apart(&shown));
    assert!((0.2..8.0).contains(&apart(&shown)) && apart(&picture.through_jpeg(20).unwrap()) > apart(&shown));
    for (_, fault, _) in FAULTS.into_iter().filter(|(_, fault, _)| *fault != Fault::Jpeg) {
        assert_eq!(fault.shown(picture.clone()).unwrap(), picture);
    }
    let none = Picture::default().through_jpeg(QUALITY).unwrap_err().to_string();
    assert!(none.contains("0 × 0"), "{none}");
}

#[test]
fn a_seed_gives_the_same_faults_on_any_number_of_threads() {
    let pair = [eval::textured(96, 64, 1), eval::textured(96, 64, 2)];
    for (name, fault, _) in FAULTS {
        assert_eq!((name.parse::<Fault>().unwrap(), fault.to_string()), (fault, name.to_owned()));
        let drawn = |threads: usize, seed: u64, pair_name: &str| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let rung = pool.install(|| Linear::of([&pair[0], &pair[1]]).expose(&camera(fault), 0.004, seed, pair_name));
            rung.pictures().map(|picture| fault.shown(picture).unwrap())
        };
        let first = drawn(1, 9, "a");
        assert!(first == drawn(3, 9, "a"), "{name}");
        assert!(first != drawn(1, 10, "a") && first != drawn(1, 9, "b"), "{name}");
    }
    let said = "row".parse::<Fault>().unwrap_err().to_string();
    assert_eq!(said, "\"row\" is no kind of noise; expected none, rows, banding, fixed, tukey, 10bit, jpeg8");
}

#[test]
fn the_command_tells_how_error_moves_with_each_kind() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("pairs");
    for name in ["a", "b"] {
        eval::frame(root.join(format!("{name}_img1.png")));
        eval::frame(root.join(format!("{name}_img2.png")));
        eval::truth(root.join(format!("{name}_flow.flo")));
    }
    let graph = dir.path().join("difference.onnx");
    fs::write(&graph, onnx_bytes::difference(None)).unwrap();
    let models = format!("zero,difference={}", graph.display());
    let [pairs, out, dark] = ["pairs", "out", "dark"].map(|name| dir.path().join(name).display().to_string());
    let eval = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_nightflow"));
        let ran = command.args(["eval", "ladder", &pairs, "--models", &models]).args(more).output().unwrap();
        (ran.status.code(), String::from_utf8(ran.stdout).unwrap(), String::from_utf8(ran.stderr).unwrap())
    };
    let kinds = "none,rows,banding,fixed,tukey,10bit,jpeg8,rows";
    let (code, text, said) = eval(&["--faults", kinds, "--out", &out, "--write", &dark]);
    assert_eq!(code, Some(0), "{said}");
    assert!(text.contains("noise fixed: columns and pixels offset alike") && text.contains("px, noise: none (mean"));
    let (_, tables) = text.split_once("### zero by noise: end-point error, px; change against none").unwrap();
    let (zero, difference) = tables.split_once("### difference by noise").unwrap();
    assert!(zero.contains("| | Exp-0 | Exp-1 |") && zero.contains("\n| none | 2.50 ± 0.00 [2] | 2.50"), "{zero}");
    for kind in ["rows", "banding", "fixed", "tukey", "10bit", "jpeg8"] {
        let line = format!("\n| {kind} | 2.50 ± 0.00 [2], +0.0 ± 0.0 % |");
        assert_eq!(zero.matches(&line).count(), 1, "{zero}");
        let line = difference.lines().find(|line| line.starts_with(&format!("| {kind} |"))).unwrap();
        assert!(line.matches(" %").count() == 7 && line.matches("+0.0 ± 0.0").count() < 7, "{line}");
        assert!(dir.path().join(format!("dark/none/Exp-3_{kind}/a_img2.png")).exists());
    }
    let pixels = |folder: &str| fs::read(dir.path().join("dark/none").join(folder).join("b_img1.png")).unwrap();
    assert_ne!(pixels("Exp-6"), pixels("Exp-6_fixed"));
    let csv = fs::read_to_string(dir.path().join("out/table.csv")).unwrap();
    assert!(csv.starts_with("condition,fault,method,pairs,") && csv.contains("\nExp-3,10bit,difference,2,"), "{csv}");
    let json: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(dir.path().join("out/table.json")).unwrap()).unwrap();
    let records = json["records"].as_array().unwrap();
    assert_eq!((records.len(), json["limits"].as_array().unwrap().len()), (2 * 2 * 7 * 7, 2 * 7));
    assert_eq!(records.iter().filter(|record| record["fault"] == "tukey").count(), 2 * 2 * 7);

    let (_, plain, _) = eval(&["--out", &out]);
    assert_eq!(plain, eval(&["--faults", "none"]).1);
    let [csv, json] =
        ["table.csv", "table.json"].map(|name| fs::read_to_string(dir.path().join("out").join(name)).unwrap());
    assert!(!format!("{plain}{csv}{json}").contains("fault") && !plain.contains("noise:"), "{plain}");
    // The draws of the camera's noise are the same beside other kinds.
    let cells = |text: &str| text.split("\n### ").nth(1).unwrap().split_once('\n').unwrap().1.to_owned();
    assert_eq!(cells(&plain), cells(&text));
    let (code, _, said) = eval(&["--faults", "none,rain"]);
    assert!(code != Some(0) && said.contains("\"rain\" is no kind of noise; expected none, rows, banding"), "{said}");
}
