//! What lies in `launch_configs/`: each file is read by what will read it in the field, and the README knows them all.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use nightflow::{
    camera::SourceConfig,
    config::Config,
    motion::Mount,
    publish::autopilot::{Autopilot, Link, Word, px4::Topic},
};

use crate::peers;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("launch_configs")
}

fn text(name: &str) -> String {
    fs::read_to_string(folder().join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

fn config(name: &str) -> Config {
    Config::read(&folder().join(name)).unwrap_or_else(|error| panic!("{error}"))
}

/// The names of all files with this ending.
fn files(ending: &str) -> BTreeSet<String> {
    let names = fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.ends_with(ending)).collect()
}

#[test]
fn each_file_opens_what_it_is_for() {
    let px4 = config("px4_downward.toml");
    assert!(matches!(px4.camera.source, SourceConfig::Ros2(_)) && px4.motion.camera == Mount::Downward);
    assert_eq!(px4.publish.px4.unwrap().topics, [Topic::SensorOpticalFlow]);
    assert!(px4.publish.mavlink.is_none(), "PX4 would fuse the same flow twice");
    assert!(px4.recording.path.is_some());
    let ardupilot = config("ardupilot_downward.toml");
    let mavlink = ardupilot.publish.mavlink.unwrap();
    assert_eq!((mavlink.autopilot, mavlink.words), (Autopilot::Ardupilot, vec![Word::Flow]));
    assert!(matches!(mavlink.link, Link::Serial(_)) && ardupilot.publish.px4.is_none());
    let forward = config("forward_avoidance.toml");
    assert!(forward.motion.camera == Mount::Forward && forward.motion.obstacles.is_some());
    assert!(forward.publish.ros2.is_some() && forward.publish.iceoryx2.is_some());
    assert_eq!(forward.publish.px4.unwrap().topics, [Topic::ObstacleDistance], "what looks ahead has no flow below");
    // What stands in its comments for ArduPilot is a configuration too, in the place of PX4's.
    let text = text("forward_avoidance.toml");
    let (ours, _) = text.split_once("[publish.px4]\n").unwrap();
    let comments: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("#   ")).collect();
    let ardupilot = Config::parse(&format!("{ours}{}", comments.join("\n")), Path::new("for ArduPilot")).unwrap();
    let mavlink = ardupilot.publish.mavlink.unwrap();
    assert_eq!((mavlink.autopilot, mavlink.words), (Autopilot::Ardupilot, vec![Word::Obstacles]));
    let replay = config("replay.toml");
    let SourceConfig::Mcap(bag) = replay.camera.source else { panic!("a recording is replayed") };
    assert!(Path::new(env!("CARGO_MANIFEST_DIR")).join(bag.path).is_file());
    assert!(matches!(replay.publish.mavlink.unwrap().link, Link::Udp(_)));
}

#[test]
fn the_readme_explains_every_file() {
    let readme = text("README.md");
    for name in files("").iter().filter(|name| *name != "README.md") {
        assert!(readme.contains(&format!("`{name}`")), "README.md says nothing of {name}");
    }
}

/// An EKF weighs ODOMETRY's velocity with the accelerometer, whose word is in it already unless the settings say otherwise.
#[test]
fn an_ekf_is_not_told_the_accelerometers_word_twice() {
    let folder = tempfile::tempdir().unwrap();
    let bag = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings/real_raw_pan.mcap");
    let run = |inertia: &str| {
        let path = folder.path().join("odometry.toml");
        let settings = format!(
            "[camera.source.mcap]\npath = {bag:?}\n[motion]\n{inertia}\n[publish.mavlink]\nwords = [\"odometry\"]\nhz = -1.0\n"
        );
        fs::write(&path, settings).unwrap();
        let output =
            Command::new(env!("CARGO_BIN_EXE_nightflow")).arg("run").arg("--config").arg(&path).output().unwrap();
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let said = run("");
    assert!(said.contains("set inertia = false in [motion]"), "{said}");
    // With it the settings go on to the next thing that is wrong with these.
    let said = run("inertia = false");
    assert!(said.contains("hz is -1"), "{said}");
}

/// Where ROS 2 is not installed its launch file can't be run, but Python can read it, and what it names can be looked for.
#[test]
fn the_ros_2_launch_file_is_python_and_names_what_is_there() {
    let script = "
import ast, sys
tree = ast.parse(open(sys.argv[1]).read(), sys.argv[1])
compile(tree, sys.argv[1], 'exec')
names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
assert 'generate_launch_description' in names, names
for node in ast.walk(tree):
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.endswith('.toml') and ' ' not in node.value:
        print(node.value)
";
    let launch = folder().join("nightflow.launch.py");
    let output = Command::new(peers::python()).arg("-c").arg(script).arg(&launch).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let named: BTreeSet<String> = String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect();
    assert_eq!(named, files(".toml"));
    // What it starts are words of the program's own.
    for words in [["run", "--config"], ["replay", "--config"], ["replay", "--realtime"]] {
        let help = Command::new(env!("CARGO_BIN_EXE_nightflow")).args([words[0], "--help"]).output().unwrap();
        let help = String::from_utf8(help.stdout).unwrap();
        assert!(help.contains(words[1]), "{words:?}: {help}");
        assert!(text("nightflow.launch.py").contains(&format!("\"{}\"", words[1])));
    }
}

#[test]
fn the_systemd_unit_is_one_and_keeps_shared_memory() {
    let unit = text("nightflow.service");
    let lines: BTreeSet<&str> = unit.lines().map(str::trim).collect();
    for needed in ["Restart=always", "RemoveIPC=no", "DynamicUser=no", "PrivateTmp=no", "User=nightflow"] {
        assert!(lines.contains(needed), "{needed} is missing:\n{unit}");
    }
    let start = lines.iter().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
    let [program, "run", "--config", launch] = start.split(' ').collect::<Vec<_>>()[..] else { panic!("{start}") };
    assert!(folder().join(Path::new(launch).file_name().unwrap()).is_file(), "{launch} is none of ours");
    // Every setting is of the form that systemd reads, under a section of its own.
    let mut section = None;
    for line in unit.lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        match line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            Some(name) => section = Some(name),
            None => {
                assert!(section.is_some() && line.split_once('=').is_some_and(|(key, _)| !key.is_empty()), "{line}")
            }
        }
    }
    // And systemd itself, where it is installed: it looks for the program, so ours stands in for the installed one.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("nightflow.service");
    fs::write(&path, unit.replace(program, env!("CARGO_BIN_EXE_nightflow"))).unwrap();
    match Command::new("systemd-analyze").args(["verify", "--man=no"]).arg(&path).output() {
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(output.status.success() && !said.contains("nightflow.service"), "{said}");
        }
        Err(why) => eprintln!("systemd-analyze was not asked: {why}"),
    }
}
