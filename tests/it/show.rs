//! `nightflow show`: the page holds what was found, needs no network, and every picture that it names is there.

use std::{
    path::Path,
    process::{Command, Output},
};

use nightflow::darkness::flow_files::{self, Field, read_frame};

fn show(args: &[&Path]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nightflow")).arg("show").args(args).output().unwrap()
}

/// The page's text, after the check that all it names lies beside it.
fn page(folder: &Path) -> String {
    let html = std::fs::read_to_string(folder.join("index.html")).unwrap();
    assert!(!html.contains("http://") && !html.contains("https://") && !html.contains("<script"));
    let mut named = 0;
    for part in html.split("src=\"").skip(1).chain(html.split("href=\"").skip(1)) {
        let name = part.split('"').next().unwrap();
        assert!(read_frame(&folder.join(name)).unwrap().width() > 100, "{name}");
        named += 1;
    }
    assert!(named > 3, "only {named} pictures");
    html
}

#[test]
fn a_flow_file_is_shown_beside_its_frames_and_its_truth() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let field = |u: f32| Field::new(64, 48, vec![[u, 0.0]; 64 * 48]).unwrap();
    flow_files::write(&at("a_flow.flo"), &field(3.0)).unwrap();
    flow_files::write(&at("true.flo"), &field(3.5)).unwrap();
    for name in ["a_img1.ppm", "a_img2.ppm"] {
        let pixels = [b"P6 64 48 255\n".as_slice(), &[90; 64 * 48 * 3]].concat();
        std::fs::write(at(name), pixels).unwrap();
    }
    let out = at("page");
    let done = show(&[&at("a_flow.flo"), "--truth".as_ref(), &at("true.flo"), "--out".as_ref(), &out]);
    let said = String::from_utf8(done.stdout).unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(said.contains("EPE 0.50 px over 1 pairs"), "{said}");
    let html = page(&out);
    for word in ["older frame", "newer frame", "true flow", "end-point error, mean 0.50 px", "90 % below 0.50 px"] {
        assert!(html.contains(word), "the page lacks {word}");
    }
    // All flow is one vector of 3 px; the wheel's rim is the truth's 3.5 px, rounded up to 4.
    let flow = read_frame(&out.join("a_flow.png")).unwrap();
    assert_eq!(flow.dimensions(), (448, 336));
    assert_eq!(flow.get_pixel(200, 100).0, nightflow::flow::wheel::colour(3.0, 0.0, 4.0));
}

#[test]
fn mistakes_are_said_in_words_and_exit_with_two() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("torn.flo"), b"PIEH\x10\0\0\0\x10\0\0\0").unwrap();
    for (path, expected) in
        [(at("torn.flo"), "expected 2060 bytes, found 12"), (at("none.flo"), "there is no such file or folder")]
    {
        let done = show(&[&path]);
        let said = String::from_utf8(done.stderr).unwrap();
        assert_eq!(done.status.code(), Some(2), "{said}");
        assert!(said.contains(expected), "{said}");
    }
}

#[test]
fn a_recording_is_shown_by_the_network_or_by_what_it_holds() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let nightflow = |args: &[&Path]| {
        let done = Command::new(env!("CARGO_BIN_EXE_nightflow")).args(args).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        String::from_utf8(done.stdout).unwrap()
    };
    let flight = at("flight.mcap");
    let (seconds, size) = (Path::new("0.2"), Path::new("320x256"));
    nightflow(&[
        "synth".as_ref(),
        "flight".as_ref(),
        "--out".as_ref(),
        &flight,
        "--seconds".as_ref(),
        seconds,
        "--size".as_ref(),
        size,
    ]);
    let (now, kept) = (at("now"), at("kept"));
    let run = nightflow(&["show".as_ref(), &flight, "--out".as_ref(), &now, "--most".as_ref(), "4".as_ref()]);
    assert!(run.contains("run now (the recording holds no flow)"), "{run}");
    nightflow(&["replay".as_ref(), &flight, "--out".as_ref(), &at("out.mcap")]);
    // The replay keeps no truth, so what is shown of it has no error; its flow is the same to the byte.
    let shown =
        nightflow(&["show".as_ref(), &at("out.mcap"), "--out".as_ref(), &kept, "--longest".as_ref(), "8".as_ref()]);
    assert!(shown.contains("as it was recorded"), "{shown}");
    let html = page(&now);
    for word in ["EPE", "true flow", "confidence", "velocity of the body (dashed: true)", "state OK"] {
        assert!(html.contains(word), "the page lacks {word}");
    }
    // Six steps and room for four: every second one is drawn, and all are in the table.
    assert_eq!(html.matches("<h2 id=").count(), 3);
    assert_eq!(html.matches("<tr><td>step_").count(), 6);
    let again = page(&kept);
    assert_eq!(again.matches("<h2 id=").count(), 6);
    let confidence = |folder: &Path| std::fs::read(folder.join("step_000002_confidence.png")).unwrap();
    assert!(confidence(&now) == confidence(&kept), "the recorded confidence is drawn otherwise than the network's");
}
