//! How the camera sits, by what tf2's own publishers say: over DDS and zenoh, however late we come, and in a recording.

use std::{f64::consts::FRAC_1_SQRT_2, sync::Arc};

use nightflow::{
    camera::{self, Next, Sample, SourceConfig},
    clock::Stamp,
    motion::{Config, Lack, Mount, NoFlow, Odometer},
    publish::Sink,
    recording::{self, Recorder},
    wire::{CameraInfo, Header, Quaternion, TfMessage, Transform, TransformStamped, Vector3},
};

use crate::{
    autopilots::moves::{self, FOCAL, SIZE},
    peers,
    recording::{read, settings},
    ros2::{LONG, SHORT, place, until},
    zenoh::endpoint,
};

const OLDER: Stamp = Stamp(10_000_000_000);

fn edge(parent: &str, child: &str, shift: [f64; 3], [x, y, z, w]: [f64; 4]) -> TransformStamped {
    TransformStamped {
        header: Header { frame_id: parent.into(), ..Header::default() },
        child_frame_id: child.into(),
        transform: Transform {
            translation: Vector3 { x: shift[0], y: shift[1], z: shift[2] },
            rotation: Quaternion { x, y, z, w },
        },
    }
}

fn message(transforms: &[TransformStamped]) -> TfMessage {
    TfMessage { transforms: transforms.to_vec() }
}

/// A vehicle whose camera looks down as the transforms say, and moves forward and up.
fn vehicle() -> Odometer {
    let config = Config { camera: Mount::Tf, ..Config::default() };
    let action = moves::fly(1.0, 0.5, 0.2);
    let mut odometer = moves::odometer(&config, &action, OLDER, true).standing_in("base_link");
    let k = [FOCAL, 0.0, 319.5, 0.0, FOCAL, 239.5, 0.0, 0.0, 1.0];
    let header = Header { frame_id: "camera_optical".into(), ..Header::default() };
    let info = CameraInfo { header, width: SIZE[0], height: SIZE[1], k, ..CameraInfo::default() };
    odometer.info(&CameraInfo { distortion_model: "plumb_bob".into(), ..info }).unwrap();
    odometer
}

/// What a camera that looks down with its image's top forward is turned by.
const DOWN: [f64; 4] = [FRAC_1_SQRT_2, -FRAC_1_SQRT_2, 0.0, 0.0];

#[test]
fn a_tree_of_frames_mounts_the_camera() {
    let action = moves::fly(1.0, 0.5, 0.2);
    let vectors = moves::exact(&action);
    let flow = moves::flow(OLDER, &vectors);
    let given = Config { camera: Mount::Downward, camera_offset_m: [0.2, 0.1, -0.05], ..Config::default() };
    let expected = moves::odometer(&given, &action, OLDER, true).velocity(&flow, SIZE).unwrap();

    let mut odometer = vehicle();
    assert_eq!(odometer.velocity(&flow, SIZE), Err(Lack::Mount));
    assert_eq!(odometer.integrated(&flow, SIZE, false).flow, Err(NoFlow::Mount));
    // Body and camera both hang on the chassis, the camera by an arm that turns a quarter.
    odometer.transforms(&message(&[edge("/chassis", "base_link", [0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0])])).unwrap();
    assert_eq!(odometer.velocity(&flow, SIZE), Err(Lack::Mount));
    let half = std::f64::consts::FRAC_1_SQRT_2;
    odometer.transforms(&message(&[edge("chassis", "arm", [0.2, 0.0, 0.25], [0.0, 0.0, half, half])])).unwrap();
    // In the arm's axes: a tenth to the left is a tenth along its x, and its own turn is taken back.
    let turned = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(half, 0.0, 0.0, half)).inverse()
        * nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(DOWN[3], DOWN[0], DOWN[1], DOWN[2]));
    let camera = edge("arm", "camera_optical", [0.1, 0.0, 0.0], [turned.i, turned.j, turned.k, turned.w]);
    odometer.transforms(&message(std::slice::from_ref(&camera))).unwrap();
    let found = odometer.velocity(&flow, SIZE).unwrap();
    for axis in 0..3 {
        assert!((found.linear[axis] - expected.linear[axis]).abs() < 1e-9, "{found:?} {expected:?}");
    }
    assert!(odometer.integrated(&flow, SIZE, false).flow.is_ok());

    // A gimbal that moves is followed; what is no transform is refused, and the rest of its message taken.
    let wrong = edge("arm", "lamp", [f64::NAN, 0.0, 0.0], DOWN);
    let unturned = edge("chassis", "arm", [0.2, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]);
    let said = odometer.transforms(&message(&[wrong, unturned])).unwrap_err().to_string();
    assert!(said.contains("transform") && said.contains("not finite"), "{said}");
    let other = odometer.velocity(&flow, SIZE).unwrap();
    let turn = other.linear[0].atan2(other.linear[1]) - found.linear[0].atan2(found.linear[1]);
    assert!((turn.abs() - std::f64::consts::FRAC_PI_2).abs() < 0.02, "{turn}: the camera is a quarter off now");
}

#[test]
fn a_ring_of_frames_mounts_nothing() {
    let mut odometer = vehicle();
    let none = [0.0, 0.0, 0.0, 1.0];
    let ring =
        [edge("b", "camera_optical", [0.0; 3], none), edge("c", "b", [0.0; 3], none), edge("b", "c", [0.0; 3], none)];
    odometer.transforms(&message(&ring)).unwrap();
    let vectors = moves::exact(&moves::fly(1.0, 0.0, 0.0));
    assert_eq!(odometer.velocity(&moves::flow(OLDER, &vectors), SIZE), Err(Lack::Mount));
    // Another name for the camera's frame, and it is the body's own.
    let config = Config { camera: Mount::Tf, ..Config::default() };
    let mut own = Odometer::new(&config).unwrap().standing_in("camera_optical");
    own.info(&CameraInfo {
        header: Header { frame_id: "camera_optical".into(), ..Header::default() },
        k: [FOCAL, 0.0, 0.0, 0.0, FOCAL, 0.0, 0.0, 0.0, 1.0],
        ..CameraInfo::default()
    })
    .unwrap();
    assert_ne!(own.velocity(&moves::flow(OLDER, &vectors), SIZE), Err(Lack::Mount));
}

/// What the peers say.
fn expected() -> TfMessage {
    message(&[edge("base_link", "camera_optical", [0.1, -0.2, 0.3], [0.0, 0.6, 0.0, 0.8])])
}

fn heard(config: &camera::Config) -> Arc<TfMessage> {
    let mut source = camera::open(config).unwrap();
    let mut heard = None;
    until("the transforms", || {
        if let Next::Sample(Sample::Transforms(message)) = source.next(SHORT).unwrap() {
            heard = Some(message);
        }
        heard.is_some()
    });
    heard.unwrap()
}

#[test]
fn cyclonedds_told_it_before_we_came() {
    let (domain, prefix) = place();
    let topic = format!("{prefix}/tf_static");
    let mut peer = peers::spawn("dds_transforms.py", [domain.to_string(), topic.clone()]);
    peer.line_starting("sent", LONG);
    let source = SourceConfig::Ros2(camera::Ros2 { domain, ..camera::Ros2::default() });
    assert_eq!(*heard(&camera::Config { source, tf_topic: topic, ..camera::Config::default() }), expected());
}

#[test]
fn eclipse_zenoh_told_it_before_we_came_or_tells_it_after() {
    for style in ["plain", "rmw"] {
        for first in [true, false] {
            let ((domain, prefix), endpoint) = (place(), endpoint());
            let topic = format!("{prefix}/tf_static");
            let (role, ours) = if first { ("listen", "connect") } else { ("connect", "listen") };
            let args = [role, endpoint.as_str(), style, &domain.to_string(), &topic];
            let ends = |wanted: &str| if ours == wanted { vec![endpoint.clone()] } else { vec![] };
            let zenoh = camera::Zenoh { connect: ends("connect"), listen: ends("listen"), rmw: style == "rmw", domain };
            let source = SourceConfig::Zenoh(zenoh);
            let config = camera::Config { source, tf_topic: topic.clone(), ..camera::Config::default() };
            let start = || {
                let mut peer = peers::spawn("zenoh_transforms.py", args);
                peer.line_starting("sent", LONG);
                peer
            };
            let found = std::thread::scope(|scope| match first {
                true => {
                    let _peer = start();
                    heard(&config)
                }
                false => {
                    let hearing = scope.spawn(|| heard(&config));
                    let _peer = start();
                    hearing.join().unwrap()
                }
            });
            assert_eq!(*found, expected(), "{style}, the peer is there first: {first}");
        }
    }
}

#[test]
fn a_recording_keeps_it_for_its_replay() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mounted.mcap");
    let config = recording::Config { path: Some(path.clone()), ..recording::Config::default() };
    let mut recorder =
        Recorder::open(&config, &camera::Config::default(), "/nightflow", "base_link", &settings()).unwrap();
    let sample = Sample::Transforms(Arc::new(expected()));
    recorder.sample(&sample).unwrap();
    recorder.sample(&Sample::Frame(crate::recording::frame(0, 16, 8))).unwrap();
    recorder.finish().unwrap();
    let samples = read(&path, &camera::Config::default());
    assert_eq!((samples.len(), &samples[0]), (2, &sample));
    let printed = peers::run("mcap_read.py", [&path]);
    let has = |part: &str| assert!(printed.contains(part), "no {part:?} in\n{printed}");
    has("summary /tf_static tf2_msgs/msg/TFMessage ros2msg/cdr 1 reliable/keep_last/100");
    for reader in ["mcap", "rosbags"] {
        has(&format!("message {reader} /tf_static"));
    }
    // Nobody asked for it.
    let without = camera::Config { tf_topic: String::new(), ..camera::Config::default() };
    assert_eq!(read(&path, &without).len(), 1);
}
