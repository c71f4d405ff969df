//! `nightflow noise measure` as its users call it.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use nightflow::darkness::noise::Normals;

fn measure(args: &[&str]) -> Output {
    let run = Command::new(env!("CARGO_BIN_EXE_nightflow")).args(["noise", "measure"]).args(args).output();
    run.unwrap()
}

fn said(run: &Output) -> String {
    String::from_utf8_lossy(&run.stdout).into_owned() + &String::from_utf8_lossy(&run.stderr)
}

/// 640×480 of soft hills with the noise of a = 3e-4, b = 2e-6, black 600, white 15520, GBRG.
fn dump(path: &Path) {
    let mut draws = Normals::new(2, 0);
    let mut bytes = Vec::new();
    for i in 0..640 * 480 {
        let (x, y) = (f64::from(i % 640) / 640.0, f64::from(i / 640) / 480.0);
        let clean = 0.02 + 0.5 * (0.5 + 0.5 * (9.0 * x).sin() * (7.0 * y).cos()).powi(2);
        let value = clean + (3e-4 * clean + 2e-6_f64).sqrt() * draws.draw();
        let count = (600.0 + value * 14920.0).round().clamp(0.0, 16383.0) as u16;
        bytes.extend(count.to_le_bytes());
    }
    fs::write(path, bytes).unwrap();
}

#[test]
fn a_dump_is_measured_and_written_out_four_ways() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    dump(Path::new(&path("hills.raw")));
    let (csv, json, svg, png) = (path("n.csv"), path("n.json"), path("n.svg"), path("n.png"));
    let settings = ["--size", "640x480", "--pattern", "gbrg", "--black", "600", "--white", "15520"];
    let outs = ["--csv", &csv, "--json", &json, "--plot", &svg];
    let run = measure(&[&[path("hills.raw").as_str()][..], &settings, &outs].concat());
    assert_eq!(run.status.code(), Some(0), "{}", said(&run));
    let table = said(&run);
    for expected in ["hills.raw (640×480, black 600, white 15520)", "noise level", "SNR dB", "\n  G2 "] {
        assert!(table.contains(expected), "{expected}:\n{table}");
    }
    let found: serde_json::Value = serde_json::from_str(&fs::read_to_string(&json).unwrap()).unwrap();
    for plane in found[0]["planes"].as_array().unwrap() {
        let bounds = |name: &str| [0, 1].map(|i| plane[name][i].as_f64().unwrap());
        let ([a_low, a_high], [b_low, b_high]) = (bounds("a_bounds"), bounds("b_bounds"));
        // Four planes: the bounds of one in twenty may miss, so they are taken half as wide again.
        let slack = |low: f64, high: f64, truth: f64| (2.0 * truth - low - high).abs() < 1.5 * (high - low);
        assert!(slack(a_low, a_high, 3e-4) && a_high - a_low < 1e-4, "{plane}");
        assert!(slack(b_low, b_high, 2e-6) && b_high - b_low < 1e-5, "{plane}");
    }
    let lines = fs::read_to_string(&csv).unwrap();
    assert_eq!(lines.lines().count(), 5, "{lines}");
    assert!(lines.lines().all(|line| line.split(',').count() == 16), "{lines}");
    let svg = fs::read_to_string(&svg).unwrap();
    assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n") && svg.matches("<circle").count() > 800);
    let run = measure(&[&[path("hills.raw").as_str()][..], &settings, &["--plot", &png]].concat());
    assert_eq!(run.status.code(), Some(0), "{}", said(&run));
    let picture = image::open(&png).unwrap().to_rgb8();
    let red = picture.pixels().filter(|pixel| pixel.0 == [204, 51, 17]).count();
    assert!(red > 60, "{red} pixels of the red plane's colour");
}

#[test]
fn a_recording_is_measured_a_frame_a_second() {
    let bag = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/real_raw_pan.mcap").display().to_string();
    let run = measure(&[&bag]);
    assert_eq!(run.status.code(), Some(0), "{}", said(&run));
    let table = said(&run);
    for expected in ["real_raw_pan.mcap at 0.00 s (640×480, black 128, white 3398)", "at 1.00 s", "  G1 "] {
        assert!(table.contains(expected), "{expected}:\n{table}");
    }
    // The first frame is the sensor itself: its sky showed a = 1.3e-4 where darktable's profile says 1.4e-5 … 3e-5.
    let first: Vec<f64> = table
        .lines()
        .filter(|line| ["R ", "G1", "G2", "B "].iter().any(|name| line.trim_start().starts_with(name)))
        .take(4)
        .map(|line| line.split_whitespace().nth(1).unwrap().parse().unwrap())
        .collect();
    assert!(first.iter().all(|a| (0.7e-4..2.5e-4).contains(a)), "{first:?}");
}

#[test]
fn mistakes_are_answered_with_what_is_right() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    fs::write(path("a.raw"), [0; 100]).unwrap();
    for (args, expected) in [
        (vec!["a.raw"], "expected --size, --pattern, --black and --white"),
        (
            vec!["a.raw", "--size", "10x10", "--pattern", "rggb", "--black", "0", "--white", "255"],
            "10x10 counts of 16 bits are 200 bytes, found 100",
        ),
        (vec!["a.raw", "--size", "10by10"], "expected columns and rows as in 768x512"),
        (vec!["a.raw", "--pattern", "rgb"], "expected rggb, bggr, gbrg, grbg or mono"),
        (vec!["a.raw", "--plot", "noise.jpg"], "expected a name that ends in .svg or .png"),
        (vec!["a.raw", "--plots", "x"], "--plot"),
        (vec!["missing.cr2"], "no such file"),
    ] {
        let file = path(args[0]);
        let run = measure(&[&[file.as_str()][..], &args[1..]].concat());
        assert_ne!(run.status.code(), Some(0));
        assert!(said(&run).contains(expected), "{args:?}: {}", said(&run));
    }
    let help = measure(&["--help"]);
    assert!(said(&help).contains("LGPL-2.1") && said(&help).contains("--pattern rggb --black 600"), "{}", said(&help));
}

#[cfg(not(feature = "raw"))]
#[test]
fn a_build_without_rawler_names_the_flag() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("photo.cr2");
    fs::write(&path, [0; 16]).unwrap();
    let run = measure(&[&path.display().to_string()]);
    assert!(said(&run).contains("--features raw") && said(&run).contains("LGPL-2.1"), "{}", said(&run));
}
