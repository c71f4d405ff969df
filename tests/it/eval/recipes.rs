//! `nightflow eval recipes` from end to end.

use super::*;

#[test]
fn the_papers_table_has_a_row_for_every_training_and_enhancer() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).display().to_string();
    for set in ["bright", "street"] {
        frame(dir.path().join(set).join("a_img1.png"));
        frame(dir.path().join(set).join("a_img2.png"));
        truth(dir.path().join(set).join("a_flow.flo"));
    }
    // Two programs: one finds the truth in every draw; the other nothing in the second draw of the darkest.
    let nothing = uniform(24, 16, [0.0; 2]);
    for exposure in 0..7 {
        for (name, enhancer) in [("a", "none"), ("a~1", "none"), ("a", "median:5"), ("a~1", "median:5")] {
            let at = |program: &str| dir.path().join(format!("{program}/{enhancer}/Exp-{exposure}/{name}_flow.flo"));
            truth(at("sure"));
            truth(at("unsure"));
            if exposure == 6 && name == "a~1" {
                flow_files::write(&at("unsure"), &nothing).unwrap();
            }
        }
    }
    let models = format!("flownets_clean={},flownets_fcdn={},zero", path("unsure"), path("sure"));
    let given = ["--models", &models, "--enhancers", "none,median", "--draws", "2", "--out", &path("out")];
    let nightflow = |sets: &[&str], workers: &str| {
        let sets: Vec<String> = sets.iter().map(|set| path(set)).collect();
        let workers = ["--workers", workers];
        let mut command = Command::new(env!("CARGO_BIN_EXE_nightflow"));
        command.args(["eval", "recipes"]).args(sets).args(given).args(workers).output().unwrap()
    };
    let made = nightflow(&["bright", "street"], "1");
    assert_eq!(made.status.code(), Some(0), "{}", String::from_utf8_lossy(&made.stderr));
    let text = String::from_utf8(made.stdout).unwrap();
    let exact = " 0.00 ± 0.00 |".repeat(6);
    // Zero flow is 2.5 px off: in one of two draws, so 1.25 ± 1.77.
    for row in [
        format!("| `flownets_clean` | clean | none |{exact} 1.25 ± 1.77 |"),
        format!("| `flownets_fcdn` | FCDN, paper | median:5 |{exact} 0.00 ± 0.00 |"),
        format!("| `zero` |  | none |{} +0 % |", " 2.50 ± 0.00 |".repeat(7)),
        "| PWC-Net | FCDN | none | 5.31 | 5.32 | 5.29 | 5.34 | 5.37 | 5.63 | 6.09 | +15 % |".to_owned(),
    ] {
        assert!(text.contains(&row), "{row}\n{text}");
    }
    for set in ["bright", "street"] {
        let read = |ending: &str| fs::read_to_string(dir.path().join(format!("out/recipes_{set}.{ending}"))).unwrap();
        assert!(read("md").starts_with(&format!("### {set}: end-point error")) && text.contains(&read("md")));
        assert!(read("svg").contains("flownets") && read("svg").contains("FCDN, paper"));
        let whole: serde_json::Value = serde_json::from_str(&read("json")).unwrap();
        // Seven exposures, two draws, two enhancers for each program and one for zero flow.
        assert_eq!(whole["records"].as_array().unwrap().len(), 7 * 2 * (2 * 2 + 1));
    }
    // As many as there are pairs and more find the same in the same order.
    assert_eq!(String::from_utf8(nightflow(&["bright", "street"], "3").stdout).unwrap(), text);
    let twice = nightflow(&["bright", "bright"], "1");
    let said = String::from_utf8(twice.stderr).unwrap();
    assert!(!twice.status.success() && said.contains("two sets are called bright"), "{said}");
}
