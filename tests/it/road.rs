//! The whole road, by the program itself: a recording in, flow, pictures and a summary out, and the same bytes again.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
    sync::atomic::AtomicBool,
    time::Duration,
};

use nightflow::{
    camera::{self, Counts, Next, Sample, Source},
    clock::{Stamp, Untimed},
    config::Config,
    flow::{Fake, Lender, Matcher, Own},
    node::{self, Outputs},
    pipeline::{Outcome, Pipeline},
    recording::{self, Definition, Writer},
    wire,
};

use crate::bags;

fn nightflow(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nightflow")).args(args).output().unwrap()
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

fn path(folder: &Path, name: &str) -> (PathBuf, String) {
    let path = folder.join(name);
    let text = path.to_str().unwrap().to_owned();
    (path, text)
}

fn settings() -> Config {
    Config::parse(bags::SETTINGS, Path::new("test")).unwrap()
}

/// A pipeline whose network knows the pattern's step: the frames are binned 2×2, so it is half as many pixels there.
fn faked() -> Pipeline {
    let config = settings();
    let [u, v] = bags::STEP.map(|pixels| pixels as f32 / 2.0);
    Pipeline::with(&config, Matcher::with(&config.flow, Box::new(Fake::shift(u, v)))).unwrap()
}

/// Gives what it was given, then ends.
struct Scripted {
    left: std::vec::IntoIter<Result<Sample, camera::Error>>,
}

impl Source for Scripted {
    fn next(&mut self, _: Duration) -> Result<Next, camera::Error> {
        self.left.next().map_or(Ok(Next::End), |sample| sample.map(Next::Sample))
    }

    fn counts(&self) -> Counts {
        Counts::default()
    }
}

fn driven(script: Vec<Result<Sample, camera::Error>>) -> node::Report {
    let mut script = Some(script);
    let mut open = || -> Result<Box<dyn Source>, camera::Error> {
        Ok(Box::new(Scripted { left: script.take().unwrap_or_default().into_iter() }))
    };
    let stop = AtomicBool::new(false);
    let mut pipeline = faked();
    let second = Duration::from_secs(1);
    node::drive(&mut open, Some(&mut pipeline), &mut Outputs::default(), &stop, (second, None), &mut |_, _| {}).unwrap()
}

#[test]
fn flow_is_in_camera_pixels_wherever_the_network_works() {
    let mut pipeline = faked();
    let mut own = Own::default();
    assert!(matches!(pipeline.step(&bags::sample(0), &mut own, &mut Untimed), Ok(Outcome::Unpaired)));
    let Ok(Outcome::Moved(moved)) = pipeline.step(&bags::sample(1), &mut own, &mut Untimed) else { panic!("no flow") };
    assert_eq!(moved.newer.ns() - moved.older.ns(), bags::INTERVAL_NS);
    assert_eq!(moved.camera_size, bags::SIZE);
    let (flow, confidence) = own.lent();
    assert_eq!(flow.len(), 2 * moved.grid.cells());
    assert_eq!(confidence.len(), moved.grid.cells());
    for uv in flow.chunks_exact(2) {
        assert!((uv[0] - 4.0).abs() < 1e-4 && (uv[1] - 2.0).abs() < 1e-4, "{uv:?}");
    }
    let across = moved.grid.width as f32 * moved.grid.scale[0];
    assert!((across - bags::SIZE[0] as f32).abs() < 1e-3, "the raster spans {across} camera pixels");
}

#[test]
fn a_bad_frame_costs_itself_and_nothing_else() {
    let bad = |index: i64, spoil: &dyn Fn(&mut nightflow::wire::Image)| {
        let mut frame = bags::frame(index);
        spoil(&mut frame.image);
        Ok(Sample::Frame(std::sync::Arc::new(frame)))
    };
    let script = vec![
        Ok(bags::sample(0)),
        Ok(bags::sample(1)),
        bad(2, &|image| image.data.truncate(1000)),
        bad(3, &|image| image.encoding = "yuv422".into()),
        bad(4, &|image| image.step = 3),
        bad(5, &|image| (image.width, image.height) = (u32::MAX, u32::MAX)),
        bad(6, &|image| image.height = 0),
        Ok(bags::sample(7)),
        Ok(bags::sample(8)),
        Ok(bags::sample(3)),
        Ok(bags::sample(9)),
        Ok(bags::sample(10)),
        Err(camera::Error::Torn { topic: "/camera/image_raw".into(), reason: "expected 100 bytes, found 3".into() }),
        Ok(bags::sample(11)),
    ];
    let report = driven(script);
    assert_eq!(report.frames, 13);
    assert_eq!(report.spoiled["exposure"].0, 5, "{:?}", report.spoiled);
    assert_eq!(report.spoiled["clock"].0, 1);
    assert_eq!(report.spoiled["camera"].0, 1);
    assert!(report.spoiled["clock"].1.contains("went back"), "{}", report.spoiled["clock"].1);
    // 0–1, 7–8, 9–10, 10–11; frame 7 is too far from 1, and 9 starts anew after the clock went back.
    assert_eq!((report.steps, report.unpaired), (4, 3), "every frame is stepped, unpaired or spoiled");
    assert!(report.lost_anything());
}

#[test]
fn a_frozen_camera_is_blind_and_not_still() {
    let frozen = |index: i64| {
        let mut frame = bags::frame(0);
        frame.image.header.stamp = bags::frame(index).image.header.stamp;
        Ok(Sample::Frame(std::sync::Arc::new(frame)))
    };
    let report = driven((0..5).map(frozen).collect());
    assert_eq!(report.steps, 4);
    assert_eq!(report.states, [0, 0, 4]);
    assert_eq!(report.speeds.seen(), 0, "blind publishes no velocity");
}

#[test]
fn a_lost_source_is_opened_again() {
    let mut scripts = vec![
        vec![Ok(bags::sample(3)), Ok(bags::sample(4))],
        vec![
            Ok(bags::sample(0)),
            Ok(bags::sample(1)),
            Err(camera::Error::Lost { source_name: "test".into(), reason: "unplugged".into() }),
        ],
    ];
    let mut opened = 0;
    let mut open = || -> Result<Box<dyn Source>, camera::Error> {
        opened += 1;
        Ok(Box::new(Scripted { left: scripts.pop().unwrap_or_default().into_iter() }))
    };
    let stop = AtomicBool::new(false);
    let mut pipeline = faked();
    let second = Duration::from_secs(1);
    let report =
        node::drive(&mut open, Some(&mut pipeline), &mut Outputs::default(), &stop, (second, None), &mut |_, _| {})
            .unwrap();
    assert_eq!((report.frames, report.steps), (4, 3));
    assert_eq!(opened, 2);
}

#[test]
fn a_replay_gives_the_same_bytes_and_a_changed_one_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let (bag, bag_text) = path(folder.path(), "in.mcap");
    bags::write(&bag, 0..8);
    let (out, out_text) = path(folder.path(), "out.mcap");
    let (pictures, pictures_text) = path(folder.path(), "pictures");

    let run =
        nightflow(&["replay", &bag_text, "--out", &out_text, "--pictures", &pictures_text, "--pictures-every", "3"]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let summary = text(&run);
    assert!(summary.contains("frames in           8") && summary.contains("stepped             7"), "{summary}");
    for stage in ["exposure", "flow", "motion", "publish"] {
        assert!(summary.contains(stage), "{stage} is not timed:\n{summary}");
    }
    let drawn: Vec<_> = fs::read_dir(&pictures).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(drawn.iter().filter(|name| name.to_string_lossy().ends_with(".png")).count(), 3, "{drawn:?}");
    assert!(drawn.iter().any(|name| name == "velocity.svg"));

    let check = nightflow(&["replay", &out_text, "--check"]);
    assert_eq!(check.status.code(), Some(0), "{}", text(&check));
    assert!(text(&check).contains("equal to the byte"), "{}", text(&check));

    // The same outputs beside other frames: the check must name what differs.
    let (other, other_text) = path(folder.path(), "other.mcap");
    with_changed_frame(&out, &other);
    let check = nightflow(&["replay", &other_text, "--check"]);
    assert_eq!(check.status.code(), Some(1), "{}", text(&check));
    assert!(text(&check).contains("differs: /nightflow/"), "{}", text(&check));
}

/// Copies a recording, but for one pixel of its fifth frame.
fn with_changed_frame(from: &Path, to: &Path) {
    let bytes = fs::read(from).unwrap();
    let mut writer = Writer::create(to, &recording::Config::default()).unwrap();
    writer.attach_metadata("nightflow", &recording::metadata(from, "nightflow").unwrap().unwrap()).unwrap();
    let mut frames = 0;
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let mut cdr = message.data.into_owned();
        if message.channel.topic == "/camera/image_raw" {
            frames += 1;
            if frames == 5 {
                let middle = cdr.len() / 2;
                cdr[middle & !1] ^= 0x40;
            }
        }
        let schema = message.channel.schema.as_ref().unwrap();
        let definition = Definition { name: &schema.name, text: std::str::from_utf8(&schema.data).unwrap(), hash: "" };
        let [log_time, publish_time] = [message.log_time, message.publish_time].map(|ns| Stamp::from_ns(ns as i64));
        writer.write_cdr(&message.channel.topic, &definition, log_time, publish_time, &cdr).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn mistakes_are_answered_with_what_is_right() {
    let missing = nightflow(&["replay", "no_such_file.mcap"]);
    assert_eq!(missing.status.code(), Some(2));
    assert!(text(&missing).contains("no_such_file.mcap"), "{}", text(&missing));

    let option = nightflow(&["replay", "x.mcap", "--picture", "y"]);
    assert_eq!(option.status.code(), Some(2));
    assert!(text(&option).contains("--pictures"), "{}", text(&option));

    let folder = tempfile::tempdir().unwrap();
    let (file, file_text) = path(folder.path(), "wrong.toml");
    fs::write(&file, "[camera.source.ross2]\ndomain = 3\n").unwrap();
    let setting = nightflow(&["config", "--config", &file_text]);
    assert_eq!(setting.status.code(), Some(2));
    assert!(text(&setting).contains("did you mean `ros2`?"), "{}", text(&setting));

    let (empty, empty_text) = path(folder.path(), "empty.mcap");
    bags::write(&empty, 0..0);
    let none = nightflow(&["replay", &empty_text]);
    assert_eq!(none.status.code(), Some(2));
    assert!(text(&none).contains("expected frames on /camera/image_raw, found no message at all"), "{}", text(&none));
}

#[test]
fn the_printed_configuration_is_a_configuration() {
    let printed = nightflow(&["config"]);
    assert_eq!(printed.status.code(), Some(0));
    let whole = String::from_utf8(printed.stdout).unwrap();
    assert_eq!(Config::parse(&whole, Path::new("printed")).unwrap(), Config::default());
}

#[test]
fn a_width_that_the_governor_chose_is_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let (bag, bag_text) = path(folder.path(), "in.mcap");
    let (_, out) = path(folder.path(), "out.mcap");
    let mut writer = Writer::create(&bag, &recording::Config::default()).unwrap();
    let known = [("config".to_owned(), bags::SETTINGS.to_owned())].into();
    writer.attach_metadata("nightflow", &known).unwrap();
    for index in 0..6 {
        let frame = bags::frame(index);
        let stamp = frame.stamp();
        writer.write("/camera/image_raw", frame.received, stamp, &frame.image).unwrap();
        // The last one asks for more than the settings allow.
        for (_, columns) in [(2, 128), (4, 5000)].into_iter().filter(|(after, _)| *after == index) {
            let header = wire::Header { stamp: stamp.into(), frame_id: String::new() };
            writer.write("/nightflow/width", stamp, stamp, &wire::Width { header, columns }).unwrap();
        }
    }
    writer.finish().unwrap();
    let run = nightflow(&["replay", &bag_text, "--out", &out]);
    assert_eq!(run.status.code(), Some(0), "{}", text(&run));
    let steps = recording::Outputs::open(Path::new(&out), "/nightflow").unwrap();
    let steps = steps.filter(|output| output.topic == "/nightflow/step");
    let widths: Vec<u32> = steps.map(|output| wire::decode::<wire::Step>(&output.cdr).unwrap().width).collect();
    // 320 camera columns are 160 cells of the mosaic, and one vector stands for four; the frame after a change has no partner.
    assert_eq!(widths, [40, 40, 32]);
    let check = nightflow(&["replay", &out, "--check"]);
    assert_eq!(check.status.code(), Some(0), "{}", text(&check));
    assert!(text(&check).contains("equal to the byte"), "{}", text(&check));
}

#[test]
fn the_doctor_names_every_part() {
    let folder = tempfile::tempdir().unwrap();
    let (bag, _) = path(folder.path(), "in.mcap");
    bags::write(&bag, 0..3);
    let (launch, launch_text) = path(folder.path(), "launch.toml");
    fs::write(&launch, format!("{}[camera.source.mcap]\npath = {:?}\n", bags::SETTINGS, bag)).unwrap();
    let doctor = nightflow(&["doctor", "--config", &launch_text]);
    let said = text(&doctor);
    for part in [
        "processor",
        "memory pages",
        "scheduling",
        "runtime",
        "model",
        "golden output",
        "speed",
        "shared memory",
        "socket buffers",
        "camera",
    ] {
        assert!(said.lines().any(|line| line.get(9..).is_some_and(|rest| rest.starts_with(part))), "{part}:\n{said}");
    }
    assert!(said.contains("320×256 bayer_rggb16"), "{said}");
    assert_eq!(doctor.status.code(), Some(0), "{said}");
}
