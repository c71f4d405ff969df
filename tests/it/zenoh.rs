//! zenoh against eclipse-zenoh and rosbags: plain keys and rmw_zenoh's, in and out.

use std::{net::TcpListener, thread, time::Duration};

use nightflow::{
    camera::{self, Counts, Next, Sample, Source, SourceConfig},
    publish, wire,
};

use crate::{
    peers::{self, Peer},
    results,
    ros2::{LONG, SHORT, account, check_sensors, index, place, take_all, until},
};

/// An endpoint that nobody listens on.
pub fn endpoint() -> String {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    format!("tcp/127.0.0.1:{port}")
}

/// Settings of a source that listens on the endpoint.
fn config(endpoint: &str, rmw: bool) -> camera::Config {
    let (domain, prefix) = place();
    let listen = vec![endpoint.to_owned()];
    camera::Config {
        source: SourceConfig::Zenoh(camera::Zenoh { connect: vec![], listen, rmw, domain }),
        image_topic: format!("{prefix}/image"),
        info_topic: format!("{prefix}/info"),
        imu_topic: format!("{prefix}/imu"),
        range_topic: format!("{prefix}/range"),
        ..camera::Config::default()
    }
}

/// A camera that has found the source, and the tokens of the ROS graph that it sees.
fn start(role: &str, endpoint: &str, style: &str, config: &camera::Config, size: [u32; 2]) -> (Peer, Vec<String>) {
    let SourceConfig::Zenoh(camera::Zenoh { domain, .. }) = &config.source else { panic!("not over zenoh") };
    let prefix = config.image_topic.strip_suffix("/image").unwrap();
    let [width, height] = size.map(|side| side.to_string());
    let args = [role, endpoint, style, &domain.to_string(), prefix, &width, &height];
    let mut camera = peers::spawn("zenoh_camera.py", args);
    let tokens = camera.line_starting("matched", LONG);
    (camera, tokens.split(' ').skip(1).map(str::to_owned).collect())
}

fn meet(style: &str, size: [u32; 2]) -> (Box<dyn Source>, Peer, Vec<String>) {
    let endpoint = endpoint();
    let config = config(&endpoint, style != "plain");
    let source = camera::open(&config).unwrap();
    let (camera, tokens) = start("connect", &endpoint, style, &config, size);
    (source, camera, tokens)
}

fn at_full_rate(style: &str, size: [u32; 2], hz: u64) {
    let (mut source, mut camera, _) = meet(style, size);
    let count = hz * 2;
    camera.say(&format!("frames {count} {hz}"));
    let mut indices = vec![];
    let said = thread::scope(|scope| {
        let said = scope.spawn(|| camera.line_starting("sent ", LONG));
        while !said.is_finished() {
            indices.extend(take_all(source.as_mut(), SHORT));
        }
        said.join().unwrap()
    });
    indices.extend(take_all(source.as_mut(), Duration::from_millis(300)));
    eprintln!("zenoh {style} {size:?}×16 bit: {said} Hz");
    account(&indices, source.counts(), count);
    // The link is TCP and the publisher waits for it: nothing may be lost.
    assert_eq!((source.counts().arrived, source.counts().missed), (count, 0));
    assert!(camera.finish(LONG).is_empty());
}

#[test]
fn plain_frames_at_640_by_480_and_30_hz_arrive() {
    at_full_rate("plain", [640, 480], 30);
}

#[test]
fn rmw_frames_at_1280_by_1024_and_60_hz_arrive() {
    at_full_rate("rmw", [1280, 1024], 60);
}

#[test]
fn attachments_number_the_frames_in_every_form() {
    for style in ["rmw", "labelled", "unhashed"] {
        let (mut source, mut camera, _) = meet(style, [64, 48]);
        for round in 1..=3u64 {
            camera.say("frames 1 10");
            let Next::Sample(sample) = source.next(LONG).unwrap() else { panic!("{style}: no frame") };
            assert_eq!(index(&sample), round - 1, "{style}");
            assert_eq!(source.counts().missed, (round - 1) * 5, "{style}: five numbers are left out each time");
            camera.say("skip 5");
        }
    }
}

#[test]
fn the_ros_graph_shows_the_node_and_its_subscriptions() {
    let (_source, camera, tokens) = meet("rmw", [64, 48]);
    let kinds: Vec<&str> = tokens.iter().map(|token| token.split('/').nth(5).unwrap()).collect();
    assert_eq!(kinds.iter().filter(|kind| **kind == "NN").count(), 1, "{tokens:?}");
    assert_eq!(kinds.iter().filter(|kind| **kind == "MS").count(), 5, "{tokens:?}");
    assert!(tokens.iter().any(|token| token.ends_with("/NN/%/%/nightflow_camera")), "{tokens:?}");
    let image = format!("image/sensor_msgs::msg::dds_::Image_/{}/2::,5:,:,:,,", wire::type_hash::<wire::Image>());
    assert!(tokens.iter().any(|token| token.ends_with(&image)), "{tokens:?}");
    drop(camera);
}

#[test]
fn a_slow_taker_gets_the_newest_frame() {
    let (mut source, mut camera, _) = meet("plain", [64, 48]);
    for round in 1..=4u64 {
        camera.say("frames 12 200");
        camera.line_starting(&format!("sent {}", round * 12 - 1), LONG);
        // A frame is there a moment after it is counted, and before the one that it displaced is.
        until("all frames of the round", || {
            (source.counts().arrived, source.counts().displaced) == (round * 12, round * 11)
        });
        let Next::Sample(sample) = source.next(LONG).unwrap() else { panic!("no frame") };
        assert_eq!(index(&sample), round * 12 - 1, "after a pause the newest frame is given");
        assert_eq!(source.next(SHORT).unwrap(), Next::Idle, "nothing older follows");
    }
}

#[test]
fn torn_frames_are_counted_and_sensors_arrive_field_by_field() {
    for style in ["plain", "rmw"] {
        let (mut source, mut camera, _) = meet(style, [64, 48]);
        camera.say("torn");
        until("the torn frame", || source.counts().torn == 1);
        camera.say("sensors");
        let (mut info, mut imu, mut range) = (None, None, None);
        until("one of each", || {
            match source.next(SHORT).unwrap() {
                Next::Sample(Sample::Info(message)) => info = Some(message),
                Next::Sample(Sample::Imu(message)) => imu = Some(message),
                Next::Sample(Sample::Range(message)) => range = Some(message),
                _ => {}
            }
            info.is_some() && imu.is_some() && range.is_some()
        });
        check_sensors(&info.unwrap(), &imu.unwrap(), &range.unwrap());
        assert_eq!(source.counts(), Counts { torn: 1, ..Counts::default() });
    }
}

#[test]
fn a_source_that_is_there_first_finds_cameras_that_come_and_die() {
    let endpoint = endpoint();
    let mut config = config(&endpoint, true);
    let SourceConfig::Zenoh(settings) = &mut config.source else { panic!("not over zenoh") };
    (settings.connect, settings.listen) = (vec![endpoint.clone()], vec![]);
    let mut source = camera::open(&config).unwrap();
    for life in 0..2 {
        let (mut camera, _) = start("listen", &endpoint, "rmw", &config, [640, 480]);
        camera.say("frames 100000 30");
        for _ in 0..3 {
            let Next::Sample(sample) = source.next(LONG).unwrap() else { panic!("no frame in life {life}") };
            assert!(matches!(sample, Sample::Frame(_)));
        }
        camera.kill();
        take_all(source.as_mut(), Duration::from_millis(200));
    }
}

fn results_are_read(style: &str) {
    let endpoint = endpoint();
    let (domain, namespace) = place();
    let settings = publish::Zenoh { connect: vec![], listen: vec![endpoint.clone()], rmw: style == "rmw", domain };
    let mut sink = publish::zenoh::open(&results::config(&namespace), &settings).unwrap();
    let msgs = concat!(env!("CARGO_MANIFEST_DIR"), "/msgs");
    let args = [&endpoint, style, &domain.to_string(), &namespace, msgs];
    let mut reader = peers::spawn("zenoh_results.py", args);
    reader.line_starting("listening", LONG);
    results::send_until_read(&mut sink, &mut reader);
    reader.finish(LONG);
}

#[test]
fn eclipse_zenoh_reads_every_result_under_plain_keys() {
    results_are_read("plain");
}

#[test]
fn eclipse_zenoh_reads_every_result_as_rmw_zenoh_would() {
    results_are_read("rmw");
}
