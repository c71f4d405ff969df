//! Recordings: written, read by the field's own readers, and compared.

use std::{
    collections::BTreeMap,
    fs,
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use nightflow::{
    camera::{
        self, Frame, Next, Sample, Source,
        mcap::{Messages, Recording},
    },
    clock::Stamp,
    exposure::Exposed,
    flow::{
        self, Cause, Flow, Grid, State,
        priority::{self, Policy},
    },
    motion::{Integrated, Lack, NoFlow, Obstacles, SECTORS, Scale, Sector, Velocity},
    publish::{Moved, Offer, Sink},
    recording::{self, Compression, Config, Output, Outputs, Recorder, Writer, check},
    wire::{CameraInfo, Header, Image, Imu, Range, Status, Vector3},
};

use super::peers;

const START_NS: i64 = 1_700_000_000_000_000_000;

pub fn header(stamp: Stamp) -> Header {
    Header { stamp: stamp.into(), frame_id: "camera_optical".into() }
}

/// Frame `k` of a 30 Hz camera, its bytes different from every other's.
pub fn image(k: u32, width: u32, height: u32) -> Image {
    let stamp = Stamp::from_ns(START_NS + i64::from(k) * 33_333_333);
    let data = (0..width * height * 2).map(|i| (i.wrapping_mul(31) ^ k.wrapping_mul(0x9e37) >> 3) as u8).collect();
    Image {
        header: header(stamp),
        height,
        width,
        encoding: "bayer_rggb16".into(),
        is_bigendian: 0,
        step: width * 2,
        data,
    }
}

pub fn frame(k: u32, width: u32, height: u32) -> Arc<Frame> {
    let image = image(k, width, height);
    let received = Stamp::from_ns(Stamp::from(image.header.stamp).ns() + 4_000_000);
    Arc::new(Frame { image, received })
}

pub fn imu(k: u32) -> Arc<Imu> {
    let stamp = Stamp::from_ns(START_NS + i64::from(k) * 33_333_333 - 1_000_000);
    let angular_velocity = Vector3 { x: 0.25, y: -0.5, z: f64::from(k) };
    Arc::new(Imu { header: header(stamp), angular_velocity, ..Imu::default() })
}

pub fn info() -> Arc<CameraInfo> {
    let k = [300.5, 0.0, 160.0, 0.0, 300.5, 120.0, 0.0, 0.0, 1.0];
    let header = header(Stamp::from_ns(START_NS));
    Arc::new(CameraInfo {
        header,
        width: 320,
        height: 240,
        distortion_model: "plumb_bob".into(),
        k,
        ..CameraInfo::default()
    })
}

pub fn range() -> Arc<Range> {
    Arc::new(Range { header: header(Stamp::from_ns(START_NS)), range: 12.5, max_range: 40.0, ..Range::default() })
}

/// What a step found between frames `step` and `step + 1`, with a velocity unless it is blind.
pub fn moved(step: u64, state: State) -> Moved {
    let at = |k: u64| Stamp::from_ns(START_NS + k as i64 * 33_333_333);
    let (older, newer) = (at(step), at(step + 1));
    let velocity = Velocity {
        older,
        newer,
        linear: [1.5, -0.25, step as f64],
        angular: [0.0, 0.125, 0.0],
        covariance: [[0.01; 6]; 6],
        scale: Scale::Metric { distance: 12.5 },
        samples: 500,
        inliers: 400,
        quality: 200,
    };
    let velocity = if matches!(state, State::Blind(_)) { Err(Lack::Blind) } else { Ok(velocity) };
    Moved {
        step,
        older,
        newer,
        frame_id: "camera_optical".into(),
        camera_size: [16, 8],
        grid: Grid { width: 4, height: 2, scale: [4.0, 4.0] },
        gain: 20.0,
        raw_mean: 0.02,
        noise: None,
        noise_level: None,
        saturated_part: 0.0,
        confidence: 0.75,
        state,
        velocity,
        integrated: Integrated::without(older, newer, NoFlow::Blind),
        obstacles: Ok(obstacles(older, newer)),
    }
}

/// A metre and a half to the left of ahead something stands, to the right of it nothing does.
fn obstacles(older: Stamp, newer: Stamp) -> Obstacles {
    let mut sectors = [Sector::Unknown; SECTORS];
    sectors[35] = Sector::Free { confidence: 0.75 };
    sectors[38] = Sector::Occupied { ttc_s: 2.0, distance_m: 6.0, confidence: 0.875, whole: true };
    let heading = [1.0, 0.0, 0.0];
    let (speed, horizon_s, delay_s) = (Some(3.0), 8.0, 0.15);
    Obstacles { older, newer, sectors, heading, heading_sd_rad: 0.01, speed, horizon_s, delay_s }
}

/// Offers a step whose vectors depend on its number and on `shift`.
pub fn offer(sink: &mut dyn Sink, moved: &Moved, shift: f32) {
    let vectors: Vec<f32> = (0..16).map(|i| moved.step as f32 + i as f32 * 0.5 + shift).collect();
    let confidence = [0.75; 8];
    let flow =
        Flow { older: moved.older, newer: moved.newer, grid: moved.grid, vectors: &vectors, confidence: &confidence };
    sink.offer(&Offer { moved, flow, image: &Exposed::default() }).unwrap();
}

pub fn dark() -> State {
    State::Blind(Cause::Dark { raw_mean: 0.0001, needed: 0.001 })
}

pub fn settings() -> BTreeMap<String, String> {
    [("config", "[camera]\n"), ("model_sha256", "abc"), ("version", "0.1.0")]
        .map(|(key, value)| (key.to_owned(), value.to_owned()))
        .into()
}

/// Records `frames` frames, each with a gyro sample before it, and the steps between them; step 1 is blind.
pub fn record(path: &Path, frames: u32, config: Config) -> Recorder {
    let config = Config { path: Some(path.into()), ..config };
    let mut recorder =
        Recorder::open(&config, &camera::Config::default(), "/nightflow", "base_link", &settings()).unwrap();
    recorder.sample(&Sample::Info(info())).unwrap();
    recorder.sample(&Sample::Range(range())).unwrap();
    for k in 0..frames {
        recorder.sample(&Sample::Imu(imu(k))).unwrap();
        recorder.sample(&Sample::Frame(frame(k, 16, 8))).unwrap();
        if k > 0 {
            let step = u64::from(k) - 1;
            offer(&mut recorder, &moved(step, if step == 1 { dark() } else { State::Ok }), 0.0);
        }
    }
    recorder
        .status(&Status { header: header(Stamp::from_ns(START_NS)), frames: u64::from(frames), ..Status::default() })
        .unwrap();
    recorder
}

pub fn read(path: &Path, config: &camera::Config) -> Vec<Sample> {
    let mut source = Recording::open(path, config).unwrap();
    let mut samples = Vec::new();
    loop {
        match source.next(Duration::ZERO).unwrap() {
            Next::Sample(sample) => samples.push(sample),
            Next::Idle => panic!("a recording that is not paced is never idle"),
            Next::End => return samples,
        }
    }
}

#[test]
fn recording_is_ordinary_work_where_the_road_has_priority() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("patient.mcap");
    // A thread of its own, and nobody else here has this priority.
    std::thread::spawn(move || {
        let before = crate::flow::threads();
        let taken = priority::take(&flow::Config { priority: 6, ..flow::Config::default() });
        let mut recorder = record(&path, 3, Config::default());
        let late = Instant::now() + Duration::from_secs(10);
        // It is started with its starter's priority.
        while crate::flow::priorities(&before).contains(&6) {
            assert!(Instant::now() < late, "the recorder has kept its starter's priority");
            std::thread::sleep(Duration::from_millis(5));
        }
        assert_eq!(taken.is_ok(), priority::current() == Policy::RealTime(6));
        recorder.finish().unwrap();
    })
    .join()
    .unwrap();
}

#[test]
fn a_recording_is_read_back_in_the_order_in_which_the_pipeline_saw_it() {
    let folder = tempfile::tempdir().unwrap();
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        let path = folder.path().join(format!("{compression:?}.mcap"));
        let mut recorder = record(&path, 5, Config { compression, ..Config::default() });
        recorder.finish().unwrap();
        assert_eq!(recorder.lost(), 0);
        assert_eq!(recorder.synced(), recorder.written());

        let mut expected = vec![Sample::Info(info()), Sample::Range(range())];
        expected.extend((0..5).flat_map(|k| [Sample::Imu(imu(k)), Sample::Frame(frame(k, 16, 8))]));
        assert_eq!(read(&path, &camera::Config::default()), expected);

        let outputs: Vec<Output> = Outputs::open(&path, "/nightflow").unwrap().collect();
        let blind = outputs.iter().filter(|output| output.stamp == moved(1, State::Ok).newer);
        let topics: Vec<_> = blind.map(|output| output.topic.as_str()).collect();
        assert_eq!(
            topics,
            ["/nightflow/step", "/nightflow/proximity", "/nightflow/flow", "/nightflow/flow_confidence"],
            "blind has no velocity"
        );
        assert_eq!(outputs.len(), 3 * 6 + 4);
        assert_eq!(recording::metadata(&path, "nightflow").unwrap(), Some(settings()));
    }
}

#[test]
fn log_times_never_go_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("times.mcap");
    record(&path, 5, Config::default()).finish().unwrap();
    let times: Vec<u64> = Messages::open(&path).unwrap().map(|message| message.log_time).collect();
    assert!(times.is_sorted(), "{times:?}");
}

#[test]
fn the_same_calls_give_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = ["a", "b"].map(|name| {
        let inside = folder.path().join(name);
        fs::create_dir(&inside).unwrap();
        let path = inside.join("same.mcap");
        // A sync closes a chunk, and when it comes depends on the clock.
        record(&path, 5, Config { sync_s: 3600.0, ..Config::default() }).finish().unwrap();
        fs::read(path).unwrap()
    });
    assert!(bytes[0] == bytes[1], "two recordings of the same calls differ");
}

#[test]
fn a_file_that_is_there_is_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flight.mcap");
    fs::write(&path, "the flight before").unwrap();
    let mut recorder = record(&path, 2, Config::default());
    recorder.finish().unwrap();
    assert_eq!(recorder.path(), folder.path().join("flight_1.mcap"));
    assert_eq!(fs::read(&path).unwrap(), b"the flight before");
    assert_eq!(read(recorder.path(), &camera::Config::default()).len(), 6);
}

#[test]
fn python_readers_see_every_message() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("read.mcap");
    record(&path, 3, Config::default()).finish().unwrap();
    let printed = peers::run("mcap_read.py", [&path]);
    let has = |start: &str| assert!(printed.lines().any(|line| line.starts_with(start)), "no {start:?} in\n{printed}");
    has("summary /camera/image_raw sensor_msgs/msg/Image ros2msg/cdr 3 best_effort/keep_last/5 RIHS01_d31d41a9");
    has("summary /camera/camera_info sensor_msgs/msg/CameraInfo ros2msg/cdr 1 reliable/keep_last/10 RIHS01_b3dfd68f");
    has("summary /imu/data_raw sensor_msgs/msg/Imu ros2msg/cdr 3 best_effort/keep_last/5 RIHS01_7d9a00ff");
    has("summary /range sensor_msgs/msg/Range ros2msg/cdr 1 best_effort/keep_last/5 RIHS01_");
    has("summary /nightflow/step nightflow_msgs/msg/Step ros2msg/cdr 2 reliable/keep_last/10 RIHS01_");
    has("summary /nightflow/ego_motion nightflow_msgs/msg/EgoMotion ros2msg/cdr 1 reliable/keep_last/10 RIHS01_");
    has("summary /nightflow/velocity geometry_msgs/msg/TwistWithCovarianceStamped ros2msg/cdr 1 reliable");
    has("summary /nightflow/proximity sensor_msgs/msg/LaserScan ros2msg/cdr 2 reliable/keep_last/10 RIHS01_");
    has("summary /nightflow/flow sensor_msgs/msg/Image ros2msg/cdr 2 ");
    has("summary /nightflow/flow_confidence sensor_msgs/msg/Image ros2msg/cdr 2 ");
    has("summary /nightflow/status nightflow_msgs/msg/Status ros2msg/cdr 1 reliable/keep_last/10 RIHS01_");
    has("metadata nightflow config,model_sha256,version");
    has("metadata rosbag2 serialized_metadata");
    has("rosbags 19");
    for reader in ["mcap", "rosbags"] {
        let lines: Vec<&str> = printed.lines().filter(|line| line.starts_with(&format!("message {reader} "))).collect();
        assert_eq!(lines.len(), 19, "{printed}");
        let one = |topic: &str, nth: usize, values: &[&str]| {
            let line = lines.iter().filter(|line| line.split(' ').nth(2) == Some(topic)).nth(nth).unwrap();
            for value in values {
                assert!(line.contains(value), "{reader}: no {value} in {line}");
            }
        };
        let crc = crc32(&image(2, 16, 8).data);
        one("/camera/image_raw", 2, &["width=16", "encoding=bayer_rggb16", &format!("data=256:{crc:08x}")]);
        one("/imu/data_raw", 1, &["angular_velocity.y=-0.5", "angular_velocity.z=1.0"]);
        one("/camera/camera_info", 0, &["distortion_model=plumb_bob", "k[0]=300.5"]);
        one("/range", 0, &["range=12.5"]);
        one("/nightflow/step", 1, &["step=1", "state=2", "cause=too dark: raw mean 0.00010", "velocity_lacks=blind"]);
        one("/nightflow/ego_motion", 0, &["scale=0", "distance=12.5", "twist.covariance[35]=0.01", "quality=200"]);
        one("/nightflow/velocity", 0, &["header.frame_id=base_link", "twist.twist.linear.y=-0.25"]);
        one(
            "/nightflow/proximity",
            0,
            &["range_max=24.0", "ranges[38]=6.0", "ranges[35]=inf", "intensities[38]=0.875"],
        );
        one("/nightflow/proximity", 1, &["ranges[38]=nan", "intensities[38]=0.0"]);
        one("/nightflow/flow", 0, &["encoding=32FC2", "step=32", "data=64:"]);
        one("/nightflow/status", 0, &["frames=3"]);
    }
}

/// As zlib has it.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc: u32, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg()))
    })
}

#[test]
fn a_folder_of_rosbag2_is_read_file_by_file() {
    let folder = tempfile::tempdir().unwrap();
    // Ten comes after nine, whatever the letters say.
    for (split, k) in [(9, 0), (10, 1)] {
        let path = folder.path().join(format!("bag_{split}.mcap"));
        let mut writer = Writer::create(&path, &Config::default()).unwrap();
        writer.attach_metadata("nightflow", &settings()).unwrap();
        let frame = frame(k, 8, 4);
        writer.write("/camera/image_raw", frame.received, frame.stamp(), &frame.image).unwrap();
        writer.finish().unwrap();
    }
    fs::write(folder.path().join("metadata.yaml"), "rosbag2_bagfile_information:\n").unwrap();
    let samples = read(folder.path(), &camera::Config::default());
    assert_eq!(samples, [Sample::Frame(frame(0, 8, 4)), Sample::Frame(frame(1, 8, 4))]);
    assert_eq!(recording::metadata(folder.path(), "nightflow").unwrap(), Some(settings()));
}

#[test]
fn a_topic_of_another_type_is_refused_with_both_names() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("wrong.mcap");
    let mut writer = Writer::create(&path, &Config::default()).unwrap();
    let stamp = Stamp::from_ns(START_NS);
    writer.write("/camera/image_raw", stamp, stamp, &*imu(0)).unwrap();
    writer.finish().unwrap();
    let mut source = Recording::open(&path, &camera::Config::default()).unwrap();
    let said = source.next(Duration::ZERO).unwrap_err().to_string();
    let expected = "topic /camera/image_raw: expected sensor_msgs/msg/Image encoded as cdr, found sensor_msgs/msg/Imu";
    assert!(said.contains(expected), "{said}");
}

#[test]
fn a_recording_without_frames_names_the_topics_that_it_has() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("other.mcap");
    let mut writer = Writer::create(&path, &Config::default()).unwrap();
    let stamp = Stamp::from_ns(START_NS);
    writer.write("/front/image_raw", stamp, stamp, &image(0, 4, 2)).unwrap();
    writer.finish().unwrap();
    let mut source = Recording::open(&path, &camera::Config::default()).unwrap();
    let said = source.next(Duration::ZERO).unwrap_err().to_string();
    assert!(said.contains("expected frames on /camera/image_raw, found /front/image_raw"), "{said}");
    assert_eq!(source.next(Duration::ZERO).unwrap(), Next::End);
}

#[test]
fn a_paced_recording_ends_after_its_newest_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("paced.mcap");
    record(&path, 5, Config::default()).finish().unwrap();
    let source = camera::SourceConfig::Mcap(camera::Mcap { path, realtime: true });
    let mut source = camera::open(&camera::Config { source, ..camera::Config::default() }).unwrap();
    let mut frames = Vec::new();
    loop {
        match source.next(Duration::from_millis(500)).unwrap() {
            Next::Sample(Sample::Frame(frame)) => frames.push(frame.image.clone()),
            Next::Sample(_) | Next::Idle => {}
            Next::End => break,
        }
    }
    assert_eq!(frames.last(), Some(&image(4, 16, 8)));
    let counts = source.counts();
    assert_eq!((counts.arrived, counts.displaced + frames.len() as u64), (5, 5));
    assert_eq!(source.progress(), Some(1.0));
}

#[test]
fn a_check_names_the_first_value_that_differs() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("check.mcap");
    record(&path, 5, Config::default()).finish().unwrap();
    let replay = |steps: &[(u64, State, f32)]| {
        let mut check = check::Check::open(&path, "/nightflow", "base_link").unwrap();
        for (step, state, shift) in steps {
            offer(&mut check, &moved(*step, state.clone()), *shift);
        }
        check.verdict()
    };
    let said = |steps: &[(u64, State, f32)]| replay(steps).unwrap_err().to_string();
    let ok = State::Ok;
    let right = [(0, ok.clone(), 0.0), (1, dark(), 0.0), (2, ok.clone(), 0.0), (3, ok.clone(), 0.0)];
    assert_eq!(replay(&right), Ok(check::Checked { equal: 22, holes: 0 }));

    let mut shifted = right.clone();
    shifted[2].2 = 0.25;
    assert_eq!(said(&shifted), format!("/nightflow/flow at {}: flow[0, 0].u 2 ≠ 2.25", moved(2, ok.clone()).newer));
    let mut seeing = right.clone();
    seeing[1].1 = ok.clone();
    assert!(said(&seeing).contains("/nightflow/step at 1700000000.066666666: state 2 ≠ 0"), "{}", said(&seeing));
    assert!(said(&right[..3]).contains("recorded, but the replay gives none"));
    assert!(said(&right[1..]).contains("recorded, but the replay gives none"));

    let outputs = || Outputs::open(&path, "/nightflow").unwrap();
    assert_eq!(check::compare(outputs(), outputs()).unwrap().equal, 22);
    // The recording lost a step: that is a hole, not a difference.
    let holed = outputs().filter(|output| output.stamp != moved(2, State::Ok).newer);
    assert_eq!(check::compare(holed, outputs()), Ok(check::Checked { equal: 16, holes: 1 }));
    let mut last: Vec<Output> = outputs().collect();
    let index = last.iter().rposition(|output| output.topic == "/nightflow/velocity").unwrap();
    last.remove(index);
    let said = check::compare(last.into_iter(), outputs()).unwrap_err().to_string();
    assert!(said.contains("/nightflow/velocity") && said.contains("none was recorded"), "{said}");
}

#[test]
fn what_the_disk_is_too_slow_for_is_counted_and_leaves_a_hole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("slow.mcap");
    let config = Config { path: Some(path.clone()), compression: Compression::Zstd, queue_max: 1, ..Config::default() };
    let mut recorder =
        Recorder::open(&config, &camera::Config::default(), "/nightflow", "base_link", &settings()).unwrap();
    // Compressing a frame takes far longer than offering it.
    let frames: Vec<_> = (0..24).map(|k| Sample::Frame(frame(k, 640, 480))).collect();
    let mut refused = Vec::new();
    for frame in &frames {
        refused.extend(recorder.sample(frame).err());
    }
    recorder.finish().unwrap();
    let lost = recorder.lost();
    assert_eq!(refused.len() as u64, lost);
    let said = refused[0].to_string();
    assert!(said.starts_with("recording lost the frame of 17000000") && said.ends_with("1 wait for it"), "{said}");
    let sequences: Vec<(u32, u64)> =
        Messages::open(&path).unwrap().map(|message| (message.sequence, message.publish_time)).collect();
    assert_eq!(sequences.len() as u64 + lost, 24);
    for (sequence, time) in sequences {
        assert_eq!(
            Stamp::from_ns(time as i64),
            frames[sequence as usize].stamp(),
            "the numbers count the lost ones too"
        );
    }
}

#[test]
fn a_source_that_waits_loses_nothing_to_a_slow_disk() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("patient.mcap");
    let config = Config { path: Some(path.clone()), compression: Compression::Zstd, queue_max: 1, ..Config::default() };
    let source = camera::SourceConfig::Mcap(camera::Mcap { path: "read.mcap".into(), realtime: false });
    let cameras = camera::Config { source, ..camera::Config::default() };
    let mut recorder = Recorder::open(&config, &cameras, "/nightflow", "base_link", &settings()).unwrap();
    for k in 0..24 {
        recorder.sample(&Sample::Frame(frame(k, 640, 480))).unwrap();
    }
    recorder.finish().unwrap();
    assert_eq!((recorder.lost(), Messages::open(&path).unwrap().count()), (0, 24));
}
