//! Reference flow: the check by hand, what is hidden masked, what lacks named, and the result judged by `nightflow eval`.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use nightflow::darkness::{
    datasets::{self, Kind},
    flow_files::{self, Field},
    picture::Picture,
    raws::Mosaic,
    reference::{Checked, check, scenes},
};

use super::eval::textured;

#[allow(dead_code)]
#[path = "../../examples/brightness_series.rs"]
mod series;

fn nightflow(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nightflow")).args(args).output().unwrap()
}

fn said(run: &Output) -> String {
    String::from_utf8_lossy(&run.stdout).into_owned() + &String::from_utf8_lossy(&run.stderr)
}

/// A field whose vectors a pixel decides.
fn field(width: usize, height: usize, vector: impl Fn(usize, usize) -> [f32; 2]) -> Field {
    let vectors = (0..width * height).map(|at| vector(at % width, at / width)).collect();
    Field { width, height, vectors, valid: None }
}

const SIZE: [usize; 2] = [192, 128];
/// Columns and rows of a thing that moves by STEP before a ground that stands.
const THING: [std::ops::Range<usize>; 2] = [56..120, 32..96];
const STEP: usize = 12;

fn on_thing(x: usize, y: usize, moved: usize) -> bool {
    x >= moved && THING[0].contains(&(x - moved)) && THING[1].contains(&y)
}

/// What the thing hides in the newer frame: ground that it moves over.
fn hidden(x: usize, y: usize) -> bool {
    on_thing(x, y, STEP) && !on_thing(x, y, 0)
}

/// The flow there, or the flow back, of the thing and the ground.
fn moving(there: bool) -> Field {
    let (moved, step) = if there { (0, STEP as f32) } else { (STEP, -(STEP as f32)) };
    field(SIZE[0], SIZE[1], |x, y| if on_thing(x, y, moved) { [step, 0.0] } else { [0.0; 2] })
}

/// Both frames of it.
fn frames() -> [Picture; 2] {
    let [width, height] = SIZE;
    let (ground, thing) = (textured(width, height, 11), textured(width, height, 12));
    [0, STEP].map(|moved| {
        let pixel = |at: usize| {
            let (x, y) = (at % width, at / width);
            let (from, at) = if on_thing(x, y, moved) { (&thing, at - moved) } else { (&ground, at) };
            [from.rgb[3 * at], from.rgb[3 * at + 1], from.rgb[3 * at + 2]]
        };
        Picture { width, height, rgb: (0..width * height).flat_map(pixel).collect() }
    })
}

fn save(folder: &Path, name: &str, frames: &[Picture; 2]) {
    fs::create_dir_all(folder).unwrap();
    frames[0].write(&folder.join(format!("{name}_img1.png"))).unwrap();
    frames[1].write(&folder.join(format!("{name}_img2.png"))).unwrap();
}

#[test]
fn a_vector_is_believed_where_it_comes_back() {
    let Checked { field: kept, valid, length, apart } = check(&moving(true), &moving(false)).unwrap();
    for y in 0..SIZE[1] {
        for x in 0..SIZE[0] {
            assert_eq!(kept.at(x, y).is_some(), !hidden(x, y), "{x}, {y}");
        }
    }
    let area = (SIZE[0] * SIZE[1]) as f64;
    assert!((valid - (1.0 - (STEP * THING[1].len()) as f64 / area)).abs() < 1e-9, "{valid}");
    assert_eq!((length, apart), (0.0, 0.0));
    // Out of the frame nothing comes back: four of ten columns, and half a column more where it falls between pixels.
    let (there, back) = (field(10, 4, |_, _| [3.5, 0.0]), field(10, 4, |_, _| [-3.5, 0.0]));
    let checked = check(&there, &back).unwrap();
    assert!((checked.valid - 0.6).abs() < 1e-9, "{}", checked.valid);
    assert!((checked.length - 3.5).abs() < 1e-9);
    // By hand: 0.01 · (10² + 8.6²) + 0.5 = 2.24 is more than 1.4², and 0.01 · (10² + 8.5²) + 0.5 = 2.22 less than 1.5².
    for (back, believed) in [(-8.6, true), (-8.5, false), (-11.6, true), (-11.7, false)] {
        let checked = check(&field(30, 4, |_, _| [10.0, 0.0]), &field(30, 4, |_, _| [back, 0.0])).unwrap();
        assert_eq!(checked.valid > 0.0, believed, "{back}");
    }
    // What the flow back doesn't know is unknown, and flows of two sizes have nothing to do with each other.
    let torn = field(10, 4, |x, _| if x == 4 { [f32::NAN; 2] } else { [0.0; 2] });
    let checked = check(&field(10, 4, |_, _| [0.0; 2]), &torn).unwrap();
    assert!(checked.field.at(4, 1).is_none() && checked.field.at(3, 1).is_some() && checked.field.at(5, 1).is_some());
    assert_eq!(check(&there, &field(9, 4, |_, _| [0.0; 2])), None);
}

#[test]
fn the_network_finds_the_truth_and_hides_what_is_hidden() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    save(&folder.path().join("mine"), "thing", &frames());
    let made = nightflow(&["eval", "reference", &path("mine"), "--out", &path("judged")]);
    assert_eq!(made.status.code(), Some(0), "{}", said(&made));
    let kept = flow_files::read(&folder.path().join("judged/thing_flow.flo")).unwrap();
    let truth = moving(true);
    // A pixel's width beside an edge belongs to either side.
    let (mut shown, mut believed, mut masked, mut behind, mut errors) = (0, 0, 0, 0, vec![]);
    for (x, y) in (0..SIZE[1]).flat_map(|y| (0..SIZE[0]).map(move |x| (x, y))) {
        let known = kept.at(x, y);
        if hidden(x, y) {
            behind += 1;
            masked += usize::from(known.is_none());
        } else {
            shown += 1;
            believed += usize::from(known.is_some());
            let [u, v] = truth.vectors[y * SIZE[0] + x];
            errors.extend(known.map(|[found_u, found_v]| (found_u - u).hypot(found_v - v)));
        }
    }
    errors.sort_by(f32::total_cmp);
    let (middle, most) = (errors[errors.len() / 2], errors[errors.len() * 9 / 10]);
    println!("{believed} of {shown} believed, {masked} of {behind} masked, error {middle:.3}, 90 % below {most:.3} px");
    assert!(believed * 10 > shown * 8, "{believed} of {shown}");
    assert!(masked * 10 > behind * 7, "{masked} of {behind}");
    assert!(middle < 0.3 && most < 1.0, "{middle} {most}");
    let mask = flow_files::read_frame(&folder.path().join("judged/pictures/thing_mask.png")).unwrap();
    for (x, y, pixel) in mask.enumerate_pixels() {
        assert_eq!(pixel.0[0] == 255, kept.at(x as usize, y as usize).is_some());
    }
    assert!(folder.path().join("judged/pictures/thing_colours.png").exists());
    // The pairs can be photographed ever darker at once.
    let ladder = nightflow(&["eval", "ladder", &path("judged"), "--models", "zero"]);
    assert!(ladder.status.success() && said(&ladder).contains("Exp-6"), "{}", said(&ladder));
}

#[test]
fn exposures_share_the_reference_of_their_brightest() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (mine, other) = (folder.path().join("mine"), folder.path().join("other/none"));
    for name in ["01020301", "01020304", "01020309", "01030401", "01030402", "02010205", "02030401", "03010201"] {
        save(&mine, name, &frames());
    }
    // One exposure lacks a partner, another scene's brightest is torn, and of one scene there is no flow.
    fs::remove_file(mine.join("01020309_img2.png")).unwrap();
    fs::write(mine.join("01030401_img1.png"), b"torn").unwrap();
    for (exposure, name) in [(1, "01020301"), (2, "01030402"), (5, "02010205")] {
        let place = other.join(format!("exposure_{exposure}"));
        fs::create_dir_all(&place).unwrap();
        flow_files::write(&place.join(format!("{name}_flow.flo")), &moving(true)).unwrap();
        flow_files::write(&place.join(format!("{name}_back_flow.flo")), &moving(false)).unwrap();
    }
    // Of another one hardly a vector comes back: nine columns that stand.
    let odd = field(SIZE[0], SIZE[1], |x, _| if x < 9 { [0.0; 2] } else { [12.0, 0.0] });
    flow_files::write(&other.join("exposure_1/03010201_flow.flo"), &odd).unwrap();
    let still = field(SIZE[0], SIZE[1], |_, _| [0.0; 2]);
    flow_files::write(&other.join("exposure_1/03010201_back_flow.flo"), &still).unwrap();
    // One scene has a truth, which the reference is compared with.
    flow_files::write(&mine.join("02010205_flow.flo"), &moving(true)).unwrap();
    let model = format!("other={}", path("other"));
    let made = nightflow(&["eval", "reference", &path("mine"), "--model", &model, "--out", &path("judged")]);
    let text = said(&made);
    assert_eq!(made.status.code(), Some(3), "{text}");
    assert!(text.contains("Left out: 4") && text.contains("there is no 01020309_img2.*"), "{text}");
    assert!(text.contains("- 01030401: ") && text.contains("02030401_flow.flo"), "{text}");
    assert!(
        text.contains("- 03010201: expected 10 % of its vectors to come back") && text.contains("found 4.7 %"),
        "{text}"
    );
    assert!(text.contains("| 01020301 | 2 | 96.9 | 0.00 | 0.000 | – | – | – |"), "{text}");
    assert!(
        text.contains("| 01030402 | 1 |") && text.contains("| 02010205 | 1 | 96.9 | 0.00 | 0.000 | 0.000 | 0.000 |")
    );
    assert_eq!(fs::read(folder.path().join("judged/reference.md")).unwrap(), made.stdout);
    let kept = flow_files::read(&folder.path().join("judged/01020301_flow.flo")).unwrap();
    assert_eq!(kept.errors(&moving(true)).unwrap().iter().flatten().filter(|error| error.is_infinite()).count(), 768);
    // Whoever finds the same is without error on every exposure that there is, and what is hidden is nobody's.
    for exposure in ["exposure_4", "exposure_2"] {
        fs::create_dir_all(other.join(exposure)).unwrap();
    }
    fs::copy(other.join("exposure_1/01020301_flow.flo"), other.join("exposure_4/01020304_flow.flo")).unwrap();
    let judged = nightflow(&["eval", &path("judged"), "--models", &format!("zero,{model}")]);
    let text = said(&judged);
    assert_eq!(judged.status.code(), Some(0), "{text}");
    for exposure in [1, 2, 4, 5] {
        assert!(text.contains(&format!("| exposure {exposure} | 2.06 [1] | 0.00 [1] |")), "{text}");
    }
}

#[test]
fn mistakes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    save(&folder.path().join("mine"), "a", &frames());
    // Its own folder is never written to.
    let own = nightflow(&["eval", "reference", &path("mine"), "--model", "zero", "--out", &path("mine")]);
    assert!(
        !own.status.success() && said(&own).contains("expected a new or an empty folder, found a_img"),
        "{}",
        said(&own)
    );
    let none = nightflow(&["eval", "reference", &path("nowhere"), "--out", &path("out")]);
    assert_eq!(none.status.code(), Some(2), "{}", said(&none));
    fs::create_dir_all(folder.path().join("sintel/clean")).unwrap();
    fs::create_dir_all(folder.path().join("sintel/flow")).unwrap();
    let said = datasets::find_unlabelled(&folder.path().join("sintel"), None).unwrap_err().to_string();
    assert!(said.contains("found the layout of sintel"), "{said}");
    // A lone flow is no pair, and without a truth none is missed.
    flow_files::write(&folder.path().join("mine/b_flow.flo"), &moving(true)).unwrap();
    let found = datasets::find_unlabelled(&folder.path().join("mine"), None).unwrap();
    assert!(found.skipped.is_empty() && found.items.len() == 1 && found.items[0].truths.is_empty(), "{found:?}");
    assert_eq!(scenes(Kind::Pairs, vec![found.items[0].clone(); 2]).len(), 2);
    let loaded = datasets::load(&found.items[0]).unwrap();
    assert_eq!((loaded.frames[1].width, loaded.truths.len()), (SIZE[0], 0));
    textured(24, 16, 3).write(&folder.path().join("mine/a_img2.png")).unwrap();
    let why = datasets::load(&found.items[0]).unwrap_err().why;
    assert!(why.contains("a_img2.png is 24×16, its older frame is 192×128"), "{why}");
    // Raws without a truth keep their shape: cells of three for X-Trans, of two for Bayer.
    let mosaic =
        |period| Mosaic { width: 6000, height: 4002, counts: vec![], black: 0.0, white: 1.0, period, colours: vec![] };
    assert_eq!(
        (mosaic(2).size_of(736), mosaic(6).size_of(736), mosaic(6).size_of(9999)),
        ((736, 491), (736, 491), (2000, 1334))
    );
}

#[test]
fn a_real_pan_is_its_own_reference() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let recording = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/real_raw_pan.mcap");
    series::write(&recording, folder.path(), 3).unwrap();
    let made = nightflow(&["eval", "reference", &path("vbof"), "--out", &path("judged")]);
    let text = said(&made);
    assert_eq!(made.status.code(), Some(0), "{text}");
    println!("{text}");
    let mean = text.lines().find(|line| line.starts_with("| mean of 2 | 12 |")).unwrap();
    let figures: Vec<f64> = mean.split('|').filter_map(|cell| cell.trim().parse().ok()).collect();
    let [12.0, valid, _, _, median, mean, _] = figures[..] else { panic!("{text}") };
    assert!(valid > 85.0 && median < 0.4 && mean < 1.0, "{text}");
    let judged = nightflow(&["eval", &path("judged"), "--models", "zero"]);
    assert!(judged.status.success() && said(&judged).contains("| exposure 6 |"), "{}", said(&judged));
}
