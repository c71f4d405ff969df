//! Shared memory seen from both ends of one process.

use ::iceoryx2::{config::Config as Iceoryx, port::subscriber::Subscriber};

use super::*;
use crate::{
    clock::Stamp,
    exposure::Exposed,
    flow::{Cause, Flow, State},
    motion::{Integrated, Lack, NoFlow, NoSight},
};

const GRID: Grid = Grid { width: 8, height: 4, scale: [4.0, 4.0] };

fn settings(name: &str) -> Iceoryx2 {
    Iceoryx2 {
        prefix: format!("nightflow_test/{name}/{}", std::process::id()),
        subscribers_max: 2,
        cells_max: GRID.cells(),
    }
}

fn moved(step: u64, grid: Grid) -> Moved {
    Moved {
        step,
        older: Stamp::from_ns(1),
        newer: Stamp::from_ns(2),
        frame_id: "camera".into(),
        camera_size: [32, 16],
        grid,
        gain: 2.0,
        raw_mean: 0.1,
        noise: None,
        noise_level: None,
        saturated_part: 0.0,
        confidence: 0.5,
        state: State::Blind(Cause::Frozen),
        velocity: Err(Lack::Blind),
        integrated: Integrated::without(Stamp::from_ns(1), Stamp::from_ns(2), NoFlow::Blind),
        obstacles: Err(NoSight::Off),
    }
}

fn subscriber(node: &Node<Service>, settings: &Iceoryx2, name: &str) -> Subscriber<Service, [f32], FlowHeader> {
    let service = node.service_builder(&service_name(&settings.prefix, name).unwrap());
    let service = service.publish_subscribe::<[f32]>().user_header::<FlowHeader>().open().unwrap();
    service.subscriber_builder().create().unwrap()
}

fn node() -> Node<Service> {
    NodeBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create().unwrap()
}

/// Lends, writes `step` into every cell and sends.
fn step(sink: &mut SharedSink, step: u64) -> Result<(), Error> {
    let canvas = sink.lender().lend(&GRID);
    canvas.flow.fill(step as f32);
    canvas.confidence.fill(0.5);
    sink.send(&moved(step, GRID))
}

#[test]
fn the_very_memory_that_was_lent_is_sent() {
    let settings = settings("zero_copy");
    let mut sink = SharedSink::open(&Config::default(), &settings).unwrap();
    let node = node();
    let (flow, confidence) = (subscriber(&node, &settings, "flow"), subscriber(&node, &settings, "confidence"));

    let canvas = sink.lender().lend(&GRID);
    let (at, beside) = (canvas.flow.as_ptr(), canvas.confidence.as_ptr());
    canvas.flow.iter_mut().enumerate().for_each(|(i, value)| *value = i as f32);
    canvas.confidence.fill(0.25);
    let loan = sink.lent.as_ref().unwrap();
    assert_eq!((loan.0.payload().as_ptr(), loan.1.payload().as_ptr()), (at, beside), "the network writes into loans");
    assert_eq!((sink.lent().0.as_ptr(), sink.lent().1.as_ptr()), (at, beside), "the other sinks read from them");

    // Another writes through the same address after the sink was asked for it: what arrives shows that nothing of
    // it was copied before.
    let canvas = sink.lender().lend(&GRID);
    assert_eq!(canvas.flow.as_ptr(), at, "what was not sent is lent again");
    canvas.flow[3] = -1.0;
    sink.displaced(9);
    sink.send(&moved(5, GRID)).unwrap();
    let (got, sure) = (flow.receive().unwrap().unwrap(), confidence.receive().unwrap().unwrap());
    let expected: Vec<f32> = (0..64).map(|i| if i == 3 { -1.0 } else { i as f32 }).collect();
    assert_eq!(got.payload(), expected);
    assert_eq!(sure.payload(), [0.25; 32]);
    assert_eq!(got.user_header(), sure.user_header());
    let header = *got.user_header();
    assert_eq!((header.step, header.state, header.cause, header.displaced), (5, 2, 5, 9));
    assert_eq!((header.width, header.height, header.camera_width, header.scale_x), (8, 4, 32, 4.0));
    assert!(header.published_ns > 0);
    assert_eq!((sink.copied(), sink.lost()), (0, 0));
}

#[test]
fn an_offer_out_of_other_memory_is_copied_once() {
    let settings = settings("copied");
    let mut sink = SharedSink::open(&Config::default(), &settings).unwrap();
    let node = node();
    let flow = subscriber(&node, &settings, "flow");
    let moved = moved(1, GRID);
    let (vectors, confidence) = ([1.5; 64], [0.5; 32]);
    let of = Flow { older: moved.older, newer: moved.newer, grid: GRID, vectors: &vectors, confidence: &confidence };
    sink.offer(&Offer { moved: &moved, flow: of, image: &Exposed::default() }).unwrap();
    assert_eq!(flow.receive().unwrap().unwrap().payload(), vectors);
    assert_eq!(sink.copied(), 1);
}

#[test]
fn when_readers_hold_everything_the_step_goes_on_and_is_counted() {
    let settings = settings("held");
    // Less memory than its readers may hold between them.
    let mut sink = SharedSink::open_on(NodeBuilder::new(), &settings, 3, || None).unwrap();
    let node = node();
    let reader = subscriber(&node, &settings, "flow");
    let mut held = Vec::new();
    for k in 0..2 {
        step(&mut sink, k).unwrap();
        held.extend(reader.receive().unwrap());
    }
    assert_eq!(held.len(), 2);
    step(&mut sink, 2).unwrap();
    let refused = step(&mut sink, 3).unwrap_err().to_string();
    assert_eq!(refused, "iceoryx2 lost the flow of step 3: readers hold every sample");
    assert_eq!(sink.lent().0, [3.0; 64], "memory of our own was lent instead");
    assert_eq!(sink.lost(), 1);
    drop(held);
    step(&mut sink, 4).unwrap();
    let newest = std::iter::from_fn(|| reader.receive().unwrap()).last().unwrap();
    assert_eq!((newest.payload()[0], newest.user_header().lost), (4.0, 1));
}

#[test]
fn a_flow_above_the_limit_is_refused_with_both_numbers() {
    let mut sink = SharedSink::open(&Config::default(), &settings("large")).unwrap();
    let grid = Grid { width: 9, height: 4, ..GRID };
    assert_eq!(sink.lender().lend(&grid).flow.len(), 72, "the network can write all the same");
    let said = sink.send(&moved(0, grid)).unwrap_err().to_string();
    assert!(said.contains("flow of 9×4 has 36 cells, [publish.iceoryx2] cells_max allows 32"), "{said}");
}

#[test]
fn too_little_shared_memory_is_said_before_anything_is_sent() {
    let settings = Iceoryx2 { cells_max: 640 * 480, ..settings("small") };
    let said = SharedSink::open_on(NodeBuilder::new(), &settings, 1, || Some(1 << 20)).map(|_| ()).unwrap_err();
    let needed = bytes_needed(640 * 480, 2);
    assert!(said.to_string().contains(&format!("1048576 bytes free, {needed} are needed")), "{said}");
}

#[test]
fn full_flow_of_vga_fits_into_the_memory_of_a_container() {
    let defaults = Iceoryx2::default();
    assert_eq!((defaults.cells_max, defaults.subscribers_max), (640 * 480, 4));
    assert!(bytes_needed(640 * 480, 4) <= 64 << 20, "{} bytes", bytes_needed(640 * 480, 4));

    // What iceoryx2 really makes, told from all else by a prefix of its own.
    let mut config = Iceoryx::default();
    let prefix = format!("nf{}_", std::process::id());
    config.global.prefix = prefix.as_str().try_into().unwrap();
    let settings = Iceoryx2 { prefix: settings("measured").prefix, ..defaults };
    let mut sink = SharedSink::open_on(NodeBuilder::new().config(&config), &settings, samples(4), free_bytes).unwrap();
    let node: Node<Service> = NodeBuilder::new().config(&config).create().unwrap();
    let readers: Vec<_> =
        (0..4).flat_map(|_| ["flow", "confidence"].map(|name| subscriber(&node, &settings, name))).collect();
    step(&mut sink, 0).unwrap();
    let made: u64 = std::fs::read_dir("/dev/shm")
        .unwrap()
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
        .map(|entry| entry.metadata().unwrap().len())
        .sum();
    let needed = bytes_needed(640 * 480, 4);
    assert!(made > 40_000_000 && made <= needed, "{made} bytes made, {needed} promised");
    assert!(readers.iter().all(|reader| reader.receive().unwrap().is_some()));
}

#[test]
fn a_second_node_under_the_same_name_is_refused() {
    let settings = settings("twice");
    let _first = SharedSink::open(&Config::default(), &settings).unwrap();
    let said = SharedSink::open(&Config::default(), &settings).map(|_| ()).unwrap_err().to_string();
    assert!(said.contains("another node publishes there"), "{said}");
}
