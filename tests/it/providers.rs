//! Execution providers: what is not there is refused with a word, and OpenVINO, where it is, computes the same flow.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use nightflow::flow::{Config, Matcher, Operators, Precision, Provider};

use crate::{bags, peers};

fn refused(config: Config) -> String {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    match Matcher::open(&Config { models, ..config }) {
        Ok(matcher) => panic!("{:?} was opened", matcher.model()),
        Err(error) => error.to_string(),
    }
}

#[test]
fn a_provider_that_the_library_lacks_is_refused_with_what_to_do() {
    for (provider, word) in [(Provider::OpenVino, "openvino"), (Provider::TensorRt, "tensorrt"), (Provider::Acl, "acl")]
    {
        let error = refused(Config { provider, ..Config::default() });
        assert!(error.contains(&format!("provider = \"{word}\"")), "{error}");
        assert!(error.contains("was built with cpu only. To have it: "), "{error}");
        assert!(toml::from_str::<Config>(&format!("provider = {word:?}")).is_ok_and(|read| read.provider == provider));
    }
    let error = toml::from_str::<Config>("provider = \"npu\"").unwrap_err().to_string();
    assert!(error.contains("`openvino`, `cuda`, `tensorrt`, `xnnpack`"), "{error}");
}

#[test]
fn a_precision_is_refused_that_a_provider_lacks_or_a_network_was_not_judged_in() {
    let error = refused(Config { provider: Provider::Xnnpack, precision: Precision::Bf16, ..Config::default() });
    assert_eq!(error, "[flow] precision = \"bf16\": provider \"xnnpack\" can do fp32");
    let error = refused(Config { precision: Precision::Fp16, ..Config::default() });
    assert!(error.ends_with("it runs in fp32; those that were: none"), "{error}");
    let plain = Config { precision: Precision::Bf16, operators: Operators::Plain, ..Config::default() };
    let error = refused(plain);
    assert!(
        error.starts_with("[flow] precision = \"bf16\" with provider = \"cpu\": it is computed by the node's own"),
        "{error}"
    );
    let network = "raftsmall_fcdn".into();
    let error =
        refused(Config { provider: Provider::OpenVino, precision: Precision::Bf16, network, ..Config::default() });
    assert!(error.contains("raftsmall_fcdn was not shown to keep its error in it to 2 %"), "{error}");
    assert!(error.ends_with("those that were: pwcnet_fcdn, pwcnet_fcdn_fast"), "{error}");
}

/// The library with OpenVINO among the peers; PyPI has it for x86-64 alone.
#[cfg(target_arch = "x86_64")]
fn library() -> PathBuf {
    let say = "import pathlib, sysconfig; print(next(pathlib.Path(sysconfig.get_path('purelib')).glob('onnxruntime/capi/libonnxruntime.so.1.*')))";
    let output = Command::new(peers::python()).args(["-c", say]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap().trim().into()
}

#[cfg(target_arch = "x86_64")]
#[test]
fn openvino_computes_the_same_and_a_recording_of_it_replays_to_the_same_bytes() {
    // A process holds one library, so the program is asked.
    let nightflow = |args: &[&Path]| -> (Output, String) {
        let output = Command::new(env!("CARGO_BIN_EXE_nightflow")).args(args).output().unwrap();
        let said = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text).into_owned()).concat();
        (output, said)
    };
    let folder = tempfile::tempdir().unwrap();
    let within = |name: &str| folder.path().join(name);
    bags::write(&within("in.mcap"), 0..4);
    for precision in ["fp32", "bf16"] {
        let (launch, out) = (within("launch.toml"), within(&format!("{precision}.mcap")));
        let flow = format!("[flow]\nruntime = {:?}\nprovider = \"openvino\"\nprecision = {precision:?}\n", library());
        let source = format!("[camera.source.mcap]\npath = {:?}\n", within("in.mcap"));
        fs::write(&launch, format!("{}{flow}{source}", bags::SETTINGS)).unwrap();

        // With the golden output, of whose values fewer bits may change more.
        let (output, said) = nightflow(&["doctor".as_ref(), "--config".as_ref(), &launch]);
        assert_eq!(output.status.code(), Some(0), "{said}");
        let line = |name: &str| said.lines().find(|line| line[9..].starts_with(name)).unwrap_or_default().to_owned();
        assert!(line("golden output").starts_with("ok"), "{said}");
        let runtime = line("runtime");
        let given = runtime.split("OpenVINOExecutionProvider (").nth(1).and_then(|rest| rest.split(' ').next());
        assert!(given.is_some_and(|nodes| nodes.parse::<u32>().is_ok_and(|nodes| nodes > 100)), "{runtime}");

        let (output, said) =
            nightflow(&["replay".as_ref(), &within("in.mcap"), "--config".as_ref(), &launch, "--out".as_ref(), &out]);
        assert_eq!(output.status.code(), Some(0), "{said}");
        let (output, said) = nightflow(&["replay".as_ref(), &out, "--check".as_ref()]);
        assert_eq!(output.status.code(), Some(0), "{said}");
        assert!(said.contains("equal to the byte"), "{said}");
    }
}
