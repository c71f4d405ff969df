//! The live node by the program itself: a recording at its own pace as the camera, a watcher beside it, an interrupt.

use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use crate::bags;

fn wait_for(what: &str, limit: Duration, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < limit, "{what} did not happen within {limit:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_node_is_watched_interrupted_and_its_recording_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("in.mcap");
    // Ten seconds at 30 Hz: longer than this test lets the node live.
    bags::write(&bag, 0..300);
    let prefix = format!("nightflow_live_{}", std::process::id());
    let kept = folder.path().join("kept.mcap");
    let launch = folder.path().join("launch.toml");
    let text = format!(
        "{}[camera.source.mcap]\npath = {bag:?}\nrealtime = true\n[publish.iceoryx2]\nprefix = {prefix:?}\n[recording]\npath = {kept:?}\n",
        bags::SETTINGS
    );
    fs::write(&launch, text).unwrap();
    let node = Command::new(env!("CARGO_BIN_EXE_nightflow"))
        .args(["run", "--config"])
        .arg(&launch)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();

    let watch = Command::new(env!("CARGO_BIN_EXE_nightflow"))
        .args(["watch", "--prefix", &prefix, "--count", "3", "--wait-s", "30"])
        .output()
        .unwrap();
    let seen = String::from_utf8_lossy(&watch.stdout).into_owned();
    assert!(watch.status.success(), "{seen}{}", String::from_utf8_lossy(&watch.stderr));
    assert_eq!(seen.lines().count(), 3, "{seen}");

    // SAFETY: kill takes plain numbers; the process is our child and is waited for below.
    let killed = unsafe { libc::kill(node.id() as i32, libc::SIGINT) };
    assert_eq!(killed, 0);
    let ended = node.wait_with_output().unwrap();
    let summary = format!("{}{}", String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
    // The network is slower than 30 Hz here, so frames are displaced; that is said, and is no loss of data.
    assert_eq!(ended.status.code(), Some(0), "{summary}");
    assert!(summary.contains("stepped") && summary.contains("displaced by a newer frame"), "{summary}");

    let check = Command::new(env!("CARGO_BIN_EXE_nightflow")).arg("replay").arg(&kept).arg("--check").output().unwrap();
    let verdict = String::from_utf8_lossy(&check.stdout).into_owned();
    assert!(check.status.success() && verdict.contains("equal to the byte, 0 holes"), "{verdict}");
}

#[test]
fn record_keeps_every_sample_and_runs_no_network() {
    let folder = tempfile::tempdir().unwrap();
    let [bag, kept, launch] = ["in.mcap", "kept.mcap", "launch.toml"].map(|name| folder.path().join(name));
    bags::write(&bag, 0..40);
    fs::write(&launch, format!("[camera.source.mcap]\npath = {bag:?}\n[flow]\nnetwork = \"there is none\"\n")).unwrap();
    let record = Command::new(env!("CARGO_BIN_EXE_nightflow"))
        .args(["record", "--config"])
        .arg(&launch)
        .arg("--out")
        .arg(&kept)
        .output()
        .unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&record.stdout), String::from_utf8_lossy(&record.stderr));
    assert_eq!(record.status.code(), Some(0), "{said}");
    wait_for("the recording", Duration::from_secs(1), || kept.exists());
    assert_eq!(frames(&kept), frames(&bag));
    assert_eq!(frames(&kept).len(), 40);
}

/// The frames of a recording, as bytes.
fn frames(path: &Path) -> Vec<Vec<u8>> {
    let bytes = fs::read(path).unwrap();
    mcap::MessageStream::new(&bytes).unwrap().map(|message| message.unwrap().data.into_owned()).collect()
}
