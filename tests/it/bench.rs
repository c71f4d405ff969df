//! `nightflow bench`: every table is there and holds figures, a rival that can't run is named, and no test judges a time.

use std::{
    fs,
    os::unix::fs::PermissionsExt,
    path::Path,
    process::{Command, Output},
};

/// So small and so seldom that it takes seconds.
const QUICK: [&str; 7] = ["bench", "--rounds", "1", "--models", "pwcnet_fcdn_fast", "--size", "96x64"];

fn bench(more: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nightflow")).args(QUICK).args(more).output().unwrap()
}

fn said(output: &Output) -> String {
    let said = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text).into_owned()).concat();
    assert_eq!(output.status.code(), Some(0), "{said}");
    said
}

/// The cells of the only row that starts so.
fn row(text: &str, section: &str, start: &str) -> Vec<String> {
    let (_, rest) = text.split_once(&format!("## {section}")).unwrap_or_else(|| panic!("no {section}:\n{text}"));
    let rest = rest.split("\n## ").next().unwrap();
    let rows: Vec<&str> = rest.lines().filter(|line| line.starts_with(&format!("| {start} |"))).collect();
    assert_eq!(rows.len(), 1, "{start} in {section}:\n{text}");
    rows[0].trim_matches('|').split(" | ").map(|cell| cell.trim().to_owned()).collect()
}

/// A cell's number, or the first of two.
fn number(cell: &str) -> f64 {
    let number: f64 = cell.split(' ').next().unwrap().parse().unwrap_or_else(|_| panic!("{cell:?} is no number"));
    assert!(number.is_finite() && number > 0.0, "{cell:?}");
    number
}

#[test]
fn every_table_has_its_figures() {
    let folder = tempfile::tempdir().unwrap();
    let (out, epe) = (folder.path().join("out"), folder.path().join("table.csv"));
    let table = "condition,fault,method,pairs,epe\nExp-0,none,pwcnet_fcdn_fast,6,2.97\nExp-0,rows,pwcnet_fcdn_fast,6,9\n\
                 Exp-4,none,pwcnet_fcdn_fast,6,3.21\nExp-4,none,\"a, b\",6,1\n";
    fs::write(&epe, table).unwrap();
    let text = said(&bench(&["--out", out.to_str().unwrap(), "--epe", epe.to_str().unwrap()]));

    for line in ["cores", "load", "of ONNX Runtime", "images of 96×64, threads: 2, rounds: 1"] {
        assert!(text.lines().any(|found| found.starts_with("- ") && found.contains(line)), "{line}:\n{text}");
    }
    let step = row(&text, "The network's step", "pwcnet_fcdn_fast");
    // One round has one ratio.
    let [fused, plain, ratio] = [1, 2, 3].map(|at| number(&step[at]));
    assert!((fused / plain - ratio).abs() < 0.02 + 0.1 * ratio, "{step:?}");
    assert!(text.contains("Refining adds "), "{text}");
    // Where the processor has tiles, and only there.
    let fast = nightflow::flow::convolutions::Unit::best().is_fast();
    assert_eq!(step[4..].iter().all(|cell| cell != "–"), fast, "{step:?}");
    assert_eq!(text.contains("| pwcnet_fcdn_fast, bf16 |"), fast, "{text}");

    let grows = "How the cost of pwcnet_fcdn_fast grows";
    for size in ["48×32, continued to 64×32", "96×64", "192×128", "384×256"] {
        for threads in ["1", "2"] {
            let cells = row(&text, grows, &format!("{size} | {threads}"));
            assert_eq!(cells.len(), 6, "{cells:?}");
            (2..5).for_each(|at| _ = number(&cells[at]));
            assert!(size != "96×64" || cells[4] == "1.00", "{cells:?}");
        }
    }
    let limit = row(&text, "How near the processor's limit", "pwcnet_fcdn_fast");
    (1..6).for_each(|at| _ = number(&limit[at]));
    assert!(
        (number(&limit[1]) - 2.0 * 2.081 * 0.075).abs() < 0.01,
        "three fortieths of what is noted for 320×256: {limit:?}"
    );
    let memory = row(&text, "Memory that a network takes", "pwcnet_fcdn_fast");
    assert!(memory[1..].iter().all(|cell| cell.parse::<f64>().is_ok()), "{memory:?}");
    assert!(!text.contains("OpenVINO"), "nobody asked for rivals:\n{text}");

    let read = |name: &str| fs::read_to_string(out.join(name)).unwrap();
    assert!(text.starts_with(&read("bench.md")), "{text}");
    assert!(read("bench.svg").contains("pwcnet_fcdn_fast"));
    let picture = read("epe_ms.svg");
    assert!(picture.contains("Exp-4 filled") && picture.matches("<circle").count() >= 2, "{picture}");
    assert!(!text.contains("for want of an end-point error"), "{text}");
}

/// A Python without any package: what is imported besides its own library is not found.
fn bare(folder: &Path) -> String {
    let path = folder.join("bare-python");
    // -I and -S leave out every folder of packages.
    fs::write(&path, "#!/bin/sh\nexec python3 -I -S \"$@\"\n").unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_rival_that_is_missing_is_named_with_what_to_do_and_the_rest_is_printed() {
    let folder = tempfile::tempdir().unwrap();
    let python = bare(folder.path());
    let text = said(&bench(&["--rivals", "--python", &python]));
    for (rival, package) in [("OpenVINO", "openvino=="), ("OpenCV", "opencv-python-headless==")] {
        let line = text.lines().find(|line| line.starts_with(&format!("- {rival}: "))).unwrap_or_default();
        let (_, way) = line.split_once(&format!("To have it: {python} -m pip install ")).unwrap_or_default();
        assert!(way.contains(package) && way.contains("numpy=="), "{rival}: {line:?}\n{text}");
    }
    assert_eq!(row(&text, "The same weights in OpenVINO", "pwcnet_fcdn_fast")[2..4], ["–", "–"]);
    assert_eq!(row(&text, "The same weights in OpenVINO", "pwcnet_fcdn_fast")[5..], ["–", "–"]);
    number(&row(&text, "The network's step", "pwcnet_fcdn_fast")[3]);
    number(&row(&text, "How near the processor's limit", "pwcnet_fcdn_fast")[3]);

    let text = said(&bench(&["--rivals", "--python", "/no/such/python"]));
    assert!(text.contains("- all rivals: /no/such/python does not start; name one by --python"), "{text}");
}

#[test]
fn a_rival_takes_its_turn() {
    // DIS and Farnebäck are among the peers' packages on no machine for sure, so a stand-in speaks the protocol.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stand-in");
    let script = "#!/bin/sh\nwhile read -r line; do case \"$line\" in *need*) echo '{\"version\":\"7.1-abc\"}';; \
                  *open*bf16*) echo '{\"error\":\"this processor has no bf16\"}';; *open*) echo '{\"opened\":\"it\"}';; \
                  *farneback*) echo '{\"error\":\"it broke\"}';; *) echo '{\"ms\":2.0}';; esac; done\n";
    fs::write(&path, script).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    let text = said(&bench(&["--rivals", "--python", path.to_str().unwrap()]));
    assert!(text.contains("- OpenVINO 7.1\n"), "{text}");
    let cells = row(&text, "The same weights in OpenVINO", "pwcnet_fcdn_fast");
    assert_eq!((cells[2].as_str(), cells[5].as_str()), ("2.0 (2.0)", "–"), "{text}");
    assert!((number(&cells[3]) - number(&cells[1]) / 2.0).abs() < 0.05, "{cells:?}");
    let methods = "Methods without a network, on 8-bit grey";
    assert_eq!(row(&text, methods, "OpenCV DIS, medium")[1], "2.0 (2.0)");
    assert_eq!(row(&text, methods, "OpenCV Farnebäck")[1..], ["–", "–"]);
    for why in ["pwcnet_fcdn_fast in OpenVINO bf16: this processor has no bf16", "OpenCV's farneback: it broke"] {
        assert!(text.contains(&format!("- {why}\n")), "{why}:\n{text}");
    }
}

#[test]
fn the_rivals_packages_are_those_of_the_other_comparisons() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/rivals");
    let script = fs::read_to_string(root.join("step.py")).unwrap();
    for line in fs::read_to_string(root.join("requirements.txt")).unwrap().lines() {
        assert!(script.contains(line), "step.py names another version than {line}");
    }
}

#[test]
fn a_wrong_option_is_answered_with_the_right_one() {
    let folder = tempfile::tempdir().unwrap();
    let odd = folder.path().join("odd.csv");
    fs::write(&odd, "name,error\n").unwrap();
    let odd = odd.to_str().unwrap();
    let asked: [(&[&str], &str); 5] = [
        (&["--models", "pwcnet"], "--models: pwcnet is no network, expected one of flownetc_clean, flownetc_fcdn, "),
        (&["--size", "320"], "expected WIDTHxHEIGHT of 16 to 4096 pixels each, as 320x256"),
        (&["--threads", "0"], "1..=256"),
        (&["--epe", odd], "--out <DIR>"),
        (
            &["--epe", odd, "--out", "x"],
            "it has no column \"condition\"; expected table.csv of nightflow eval ladder --out",
        ),
    ];
    for (args, answer) in asked {
        let output = Command::new(env!("CARGO_BIN_EXE_nightflow")).arg("bench").args(args).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
        assert!(text.contains(answer), "{args:?}: {text}");
    }
}
