//! Models and runtimes that are not what they should be are refused with what is wrong.

use super::*;

/// A copy of the committed models.
fn models() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for file in fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("models")).unwrap() {
        let path = file.unwrap().path();
        if path.is_file() {
            fs::copy(&path, folder.path().join(path.file_name().unwrap())).unwrap();
        }
    }
    folder
}

fn refusal(folder: &Path) -> String {
    match Matcher::open(&Config { models: folder.into(), ..Config::default() }) {
        Ok(_) => panic!("the model was taken"),
        Err(error) => error.to_string().replace(&folder.display().to_string(), "MODELS"),
    }
}

#[test]
fn a_model_with_one_changed_byte_is_refused() {
    let files = [(Operators::Fused, "pwcnet_fcdn_decoder_fused.onnx"), (Operators::Plain, "pwcnet_fcdn_decoder.onnx")];
    for (operators, file) in files {
        let folder = models();
        let mut bytes = fs::read(folder.path().join(file)).unwrap();
        bytes[1_000_000] ^= 1;
        fs::write(folder.path().join(file), bytes).unwrap();
        let config = Config { models: folder.path().into(), operators, ..Config::default() };
        let text = Matcher::open(&config).map(drop).unwrap_err().to_string();
        assert!(text.contains(file) && text.contains("has sha256"), "{text}");
        let config = Config { golden_check: false, ..config };
        assert!(matches!(Matcher::open(&config), Err(Error::Hash { .. })), "also without the golden check");
    }
}

#[test]
fn a_golden_output_that_differs_is_refused_unless_the_check_is_off() {
    let folder = models();
    let path = folder.path().join("manifest.toml");
    let mut manifest: toml::Table = fs::read_to_string(&path).unwrap().parse().unwrap();
    let golden = manifest["pwcnet_fcdn"]["golden"].as_table_mut().unwrap();
    golden["flow"][3] = toml::Value::Float(golden["flow"][3].as_float().unwrap() + 0.5);
    fs::write(&path, manifest.to_string()).unwrap();
    let text = refusal(folder.path());
    assert!(text.starts_with("the golden output differs at row 4, column 12: "), "{text}");
    let config = Config { models: folder.path().into(), golden_check: false, ..Config::default() };
    assert!(Matcher::open(&config).is_ok());
}

#[test]
fn a_missing_network_or_manifest_is_named() {
    let folder = models();
    let config = Config { models: folder.path().into(), network: "raft".into(), ..Config::default() };
    let text = Matcher::open(&config).map(drop).unwrap_err().to_string();
    assert!(
        text.contains(
            "network raft is not in it, it has flownetc_clean, flownetc_fcdn, flownets_clean, flownets_fcdn, pwcnet_clean, \
             pwcnet_fcdn, pwcnet_fcdn_fast, raftsmall_fcdn"
        ),
        "{text}"
    );
    fs::remove_file(folder.path().join("manifest.toml")).unwrap();
    let text = refusal(folder.path());
    insta::assert_snapshot!(text, @"MODELS/manifest.toml: No such file or directory (os error 2); set [flow] models to the folder of the models");
}

#[test]
fn a_missing_runtime_says_where_it_was_looked_for_and_what_to_install() {
    let config = Config { runtime: "/nowhere/libonnxruntime.so".into(), ..Config::default() };
    let text = Matcher::open(&config).map(drop).unwrap_err().to_string();
    insta::assert_snapshot!(text, @"
    ONNX Runtime 1.31.1 is needed and was not found. Tried:
      /nowhere/libonnxruntime.so ([flow] runtime): there is no such file
    To install it: pip install --no-deps --target /opt/onnxruntime onnxruntime==1.31.1, and set [flow] runtime or ORT_DYLIB_PATH to /opt/onnxruntime/onnxruntime/capi/libonnxruntime.so.1.31.1
    ");
}

/// What a process of its own says when this file is its runtime: a process loads one library only.
fn refused_runtime(library: &Path) -> String {
    let child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "flow::opening::a_process_of_its_own_opens_the_network", "--nocapture"])
        .env("ORT_DYLIB_PATH", library)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&child.stdout).into_owned();
    assert!(child.status.success(), "an error, not a panic: {text} {}", String::from_utf8_lossy(&child.stderr));
    text.replace(&library.display().to_string(), "LIBRARY")
}

/// With no variable set this opens the network like any other test; the next one runs it with strange libraries.
#[test]
fn a_process_of_its_own_opens_the_network() {
    match Matcher::open(&Config::default()) {
        Ok(matcher) => assert!(matcher.model().library.is_file()),
        Err(error @ Error::Runtime { .. }) if std::env::var_os("ORT_DYLIB_PATH").is_some() => println!("{error}"),
        Err(error) => panic!("{error}"),
    }
}

#[test]
fn an_old_or_strange_runtime_is_an_error_with_its_version() {
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("text.so");
    fs::write(&text, "no library").unwrap();
    let said = refused_runtime(&text);
    assert!(said.contains("LIBRARY (ORT_DYLIB_PATH): ") && said.contains("pip install"), "{said}");

    let old = folder.path().join("old.so");
    let source = folder.path().join("old.c");
    let program = r#"
        static const char *version(void) { return "1.18.0"; }
        static struct { const void *(*api)(unsigned); const char *(*version)(void); } base = { 0, version };
        const void *OrtGetApiBase(void) { return &base; }
    "#;
    fs::write(&source, program).unwrap();
    let built = Command::new("cc").args(["-shared", "-fPIC", "-o"]).args([&old, &source]).status().unwrap();
    assert!(built.success());
    let said = refused_runtime(&old);
    assert!(said.contains("expected version >= '1.24.x', but got '1.18.0'"), "{said}");
}

#[test]
fn the_runtime_is_looked_for_where_the_docs_say() {
    let executable = Path::new("/app/target/debug/deps/it");
    let shown = |set: &str, variable: Option<&str>| -> Vec<String> {
        let places = runtime::places(Path::new(set), variable.map(Into::into), Some(executable));
        places.into_iter().take(2).map(|place| format!("{}: {}", place.named_by, place.path.display())).collect()
    };
    assert_eq!(shown("/a.so", Some("/b.so")), ["[flow] runtime: /a.so"]);
    assert_eq!(shown("", Some("/b.so")), ["ORT_DYLIB_PATH: /b.so"]);
    assert_eq!(
        shown("", Some("")),
        [
            "beside the executable: /app/target/debug/deps/libonnxruntime.so",
            "above the executable: /app/target/debug/libonnxruntime.so"
        ]
    );
}

#[test]
fn an_upsampler_that_is_none_is_refused_where_it_is_needed() {
    let folder = models();
    let path = folder.path().join("manifest.toml");
    let mut manifest: toml::Table = fs::read_to_string(&path).unwrap().parse().unwrap();
    let network = manifest["pwcnet_fcdn"].as_table_mut().unwrap();
    let pyramid = network["pyramid"].clone();
    network.insert("upsampler".into(), pyramid);
    fs::write(&path, manifest.to_string()).unwrap();
    let config = |resolution| Config { models: folder.path().into(), resolution, ..Config::default() };
    let text = Matcher::open(&config(Resolution::Full)).map(drop).unwrap_err().to_string();
    assert!(text.contains("pwcnet_fcdn_pyramid.onnx") && text.contains("3 inputs"), "{text}");
    assert!(Matcher::open(&config(Resolution::Quarter)).is_ok());
    // Its bytes are checked as the others' are.
    let torn = models();
    let file = torn.path().join("upsampler_fcdn.onnx");
    let mut bytes = fs::read(&file).unwrap();
    bytes[100_000] ^= 1;
    fs::write(&file, bytes).unwrap();
    let config = Config { models: torn.path().into(), resolution: Resolution::Full, ..Config::default() };
    assert!(matches!(Matcher::open(&config), Err(Error::Hash { .. })));
}
