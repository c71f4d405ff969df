//! The rules of the house, held by a test and not by memory.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// The stages in the order of the data; each may import only those before it.
const STAGES: [&str; 6] = ["camera", "exposure", "flow", "motion", "publish", "recording"];
/// What every stage may import.
const GROUND: [&str; 3] = ["clock", "handover", "wire"];
/// Files and folders that name no socket, thread or clock. The ONNX session is the flow's one exception.
const PURE: [&str; 5] = ["exposure", "flow", "motion", "darkness", "pipeline.rs"];
const IMPURE_IN_FLOW: &str = "flow/onnx";
const BANNED_NAMES: [&str; 8] = ["manager", "handler", "util", "utils", "helper", "common", "types", "data"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(rust_files(&path));
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Path below `src/` and text of every source file; comments are left out of the text.
fn sources() -> Vec<(String, String)> {
    let src = root().join("src");
    let named = |path: PathBuf| {
        let name = path.strip_prefix(&src).unwrap().to_string_lossy().into_owned();
        (name, fs::read_to_string(&path).unwrap())
    };
    rust_files(&src).into_iter().map(named).collect()
}

fn code(text: &str) -> String {
    text.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// First path segments after `crate::`, also those in `use crate::{a, b::c}`.
fn imports(text: &str) -> Vec<String> {
    let text = code(text);
    let mut found = Vec::new();
    for (at, _) in text.match_indices("crate::") {
        let rest = &text[at + "crate::".len()..];
        if let Some(list) = rest.strip_prefix('{') {
            let mut depth = 0;
            let mut name = String::new();
            for letter in list.chars() {
                match letter {
                    '{' => depth += 1,
                    '}' if depth == 0 => break,
                    '}' => depth -= 1,
                    ',' if depth == 0 => found.push(std::mem::take(&mut name)),
                    letter if depth == 0 => name.push(letter),
                    _ => {}
                }
            }
            found.push(name);
        } else {
            found.push(rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect());
        }
    }
    found
        .iter()
        .map(|path| path.trim().split("::").next().unwrap().trim().to_owned())
        .filter(|name| !name.is_empty())
        .collect()
}

#[test]
fn imports_go_left() {
    let mut wrong = Vec::new();
    for (name, text) in sources() {
        let stage = name.split('/').next().unwrap();
        let Some(place) = STAGES.iter().position(|known| *known == stage) else { continue };
        for import in imports(&text) {
            let left = STAGES[..=place].contains(&import.as_str()) || GROUND.contains(&import.as_str());
            if !left {
                wrong.push(format!("{name} imports {import}"));
            }
        }
    }
    assert!(wrong.is_empty(), "a stage may import itself, the stages before it and the ground:\n{}", wrong.join("\n"));
}

#[test]
fn the_ground_imports_only_the_ground() {
    for (name, text) in sources() {
        if GROUND.iter().any(|ground| name == format!("{ground}.rs") || name.starts_with(&format!("{ground}/"))) {
            for import in imports(&text) {
                assert!(GROUND.contains(&import.as_str()), "{name} imports {import}");
            }
        }
    }
}

#[test]
fn pure_stages_name_no_socket_thread_or_clock() {
    let impure =
        ["std::net", "std::thread", "thread::spawn", "Instant", "SystemTime", "tokio", "Mutex", "std::process"];
    let mut wrong = Vec::new();
    for (name, text) in sources() {
        let pure = PURE.iter().any(|pure| name == *pure || name.starts_with(&format!("{pure}/")));
        if !pure || name.starts_with(IMPURE_IN_FLOW) {
            continue;
        }
        let text = code(&text);
        wrong.extend(impure.iter().filter(|word| text.contains(**word)).map(|word| format!("{name} names {word}")));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn only_the_clock_asks_the_time() {
    for (name, text) in sources() {
        let asks = text.contains("Instant::now(") || text.contains("SystemTime::now(");
        assert!(!asks || name == "clock.rs", "{name} asks the time; clock.rs is the place for that");
    }
}

#[test]
fn every_file_opens_with_its_sentence() {
    let tests = rust_files(&root().join("tests")).into_iter().map(|path| {
        let text = fs::read_to_string(&path).unwrap();
        (path.display().to_string(), text)
    });
    for (name, text) in sources().into_iter().chain(tests) {
        let first = text.lines().next().unwrap_or_default();
        assert!(first.starts_with("//! ") && first.len() > 12, "{name} opens with: {first}");
    }
}

#[test]
fn files_and_functions_are_short() {
    let mut wrong = Vec::new();
    for (name, text) in sources() {
        let lines: Vec<&str> = text.lines().collect();
        if lines.len() > 500 {
            wrong.push(format!("{name} has {} lines, at most 500", lines.len()));
        }
        for (start, line) in lines.iter().enumerate() {
            let indent = line.len() - line.trim_start().len();
            let head = line.trim_start();
            let opens = [
                "fn ",
                "pub fn ",
                "pub(crate) fn ",
                "pub(super) fn ",
                "async fn ",
                "pub async fn ",
                "unsafe fn ",
                "const fn ",
            ];
            if !opens.iter().any(|open| head.starts_with(open)) {
                continue;
            }
            let margin = " ".repeat(indent);
            let (close, arguments) = (format!("{margin}}}"), format!("{margin})"));
            // A trait's declaration over several lines has no body, and ends with its arguments.
            let ends = |line: &&str| **line == close || line.starts_with(&arguments) && line.ends_with(';');
            let length = lines[start..].iter().position(ends).map_or(0, |end| end + 1);
            if length > 70 && !head.ends_with(';') && !head.ends_with("{}") {
                wrong.push(format!("{name}:{}: {head} … has {length} lines, at most 70", start + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn names_say_what_a_file_is() {
    for (name, _) in sources() {
        for part in name.trim_end_matches(".rs").split('/') {
            assert!(!BANNED_NAMES.contains(&part), "{name}: `{part}` says nothing");
        }
    }
}

#[test]
fn every_launch_file_is_a_configuration() {
    let mut seen = 0;
    for entry in fs::read_dir(root().join("launch_configs")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|ending| ending == "toml") {
            let config = nightflow::config::Config::read(&path).unwrap_or_else(|error| panic!("{error}"));
            assert_ne!(config, nightflow::config::Config::default(), "{} changes nothing", path.display());
            let first = fs::read_to_string(&path).unwrap();
            assert!(first.starts_with("# "), "{} does not say what it is for", path.display());
            seen += 1;
        }
    }
    assert!(seen >= 4, "only {seen} launch files were found");
}
