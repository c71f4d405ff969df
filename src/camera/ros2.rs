//! Frames, gyro, range and calibration over DDS, as ROS 2 sends them.

use std::{pin::Pin, sync::Arc, thread::JoinHandle, time::Duration};

use futures::{Stream, StreamExt, future, stream};
use ros2_client::{
    CreateResult, MessageInfo, MessageTypeName, Name, NodeName, NodeOptions, QosProfile, ReadError,
    dds::{Context, Node, Spinner, Subscription},
    qos::{Durability, History, WhenFull},
};
use rustdds::{DomainParticipantBuilder, Topic};
use serde::de::DeserializeOwned;
use tokio::sync::oneshot;

use super::{
    Config, Counts, Error, Frame, Next, Ros2, Sample, Source,
    latest::{Latest, SMALL_ROOM, Sender, mailbox},
};
use crate::{
    clock,
    wire::{CameraInfo, Image, Imu, Message, Range, TfMessage},
};

/// The socket receive buffer that holds a 1280×1024 16-bit frame's datagrams while the reader is at another one. With
/// the 208 KiB of a stock kernel, 93 % of 640×480 frames were lost.
pub const RECEIVE_BUFFER_WANTED: usize = 4 << 20;

/// Frames that may wait in the reader: more than one, because its reassembly needs room; they are drained at once.
const FRAME_DEPTH: usize = 8;
/// The gyro sends many small samples while one frame is decoded.
const SMALL_DEPTH: usize = 128;
/// As many as tf2's own listener keeps.
const TF_DEPTH: usize = 100;

/// The largest socket receive buffer that the kernel grants, where it says so (Linux).
pub fn receive_buffer_max() -> Option<usize> {
    std::fs::read_to_string("/proc/sys/net/core/rmem_max").ok()?.trim().parse().ok()
}

/// What to do when the kernel grants too little for frames over DDS; `None` when it grants enough.
pub fn receive_buffer_advice(granted: usize) -> Option<String> {
    (granted < RECEIVE_BUFFER_WANTED).then(|| {
        format!(
            "sockets may buffer {granted} bytes, large frames over DDS need {RECEIVE_BUFFER_WANTED}: \
             sudo sysctl -w net.core.rmem_max={RECEIVE_BUFFER_WANTED}"
        )
    })
}

/// A live source: a thread drains the DDS readers into the mailbox as fast as they fill.
pub struct Ros2Source {
    latest: Latest,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Ros2Source {
    /// Joins the domain and subscribes. Publishers may come, go and come again at any time.
    pub fn open(config: &Config, settings: &Ros2) -> Result<Self, Error> {
        let lost = |reason: String| Error::Lost { source_name: "ros2".into(), reason };
        let mut node = join(settings.domain, "nightflow_camera", receive_buffer(settings)).map_err(lost)?;
        let readers = Readers {
            image: subscribe(&mut node, &config.image_topic, settings.reliable, FRAME_DEPTH)?,
            info: subscribe(&mut node, &config.info_topic, settings.reliable, SMALL_DEPTH)?,
            imu: subscribe(&mut node, &config.imu_topic, settings.reliable, SMALL_DEPTH)?,
            range: subscribe(&mut node, &config.range_topic, settings.reliable, SMALL_DEPTH)?,
            transforms: match config.tf_topic.as_str() {
                "" => None,
                topic => Some(subscribe_with(&mut node, topic, tf_qos(topic))?),
            },
        };
        let (sender, latest) = mailbox(SMALL_ROOM);
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("camera-ros2".into())
            .spawn(move || on_tokio(receive(node, readers, sender, stopped)))
            .map_err(|e| lost(e.to_string()))?;
        Ok(Self { latest: latest.exposing(config.exposure_s), stop: Some(stop), thread: Some(thread) })
    }
}

impl Source for Ros2Source {
    fn next(&mut self, wait: Duration) -> Result<Next, Error> {
        self.latest.next(wait)
    }

    fn counts(&self) -> Counts {
        self.latest.counts()
    }
}

impl Drop for Ros2Source {
    fn drop(&mut self) {
        // Dropping the sender is the message.
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // A panic of that thread was told by the mailbox's end already.
            let _ = thread.join();
        }
    }
}

/// Joins a DDS domain as a node of this name. A participant of its own, so that stages don't wait for each other.
pub(crate) fn join(domain: u16, name: &str, receive_buffer: usize) -> Result<Node, String> {
    let participant = DomainParticipantBuilder::new(domain)
        .socket_receive_buffer_size(receive_buffer)
        .build()
        .map_err(|e| format!("DDS domain {domain} can't be joined: {e}"))?;
    let context = Context::from_domain_participant(participant).map_err(|e| e.to_string())?;
    let name = NodeName::new("/", name).map_err(|e| e.to_string())?;
    let options = NodeOptions::new().enable_rosout(false).start_parameter_services(false);
    context.new_node(name, options).map_err(|e| format!("{e:?}"))
}

/// A topic for messages of type `M`.
pub(crate) fn topic<M: Message>(node: &Node, name: &str, qos: &QosProfile) -> Result<Topic, String> {
    let parsed = Name::parse(name).map_err(|e| format!("{name} is no name of a topic: {e}"))?;
    node.create_topic(&parsed, MessageTypeName::new(M::PACKAGE, M::NAME), qos).map_err(|e| format!("{name}: {e}"))
}

/// Runs an edge's future on a runtime of this thread alone; no future reaches the frame path.
pub(crate) fn on_tokio(edge: impl Future<Output = ()>) {
    match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime.block_on(edge),
        Err(e) => tracing::error!("no runtime for the edge to DDS: {e}"),
    }
}

/// Keeps the node in the ROS graph until it is dropped.
pub(crate) async fn spin(spinner: CreateResult<Spinner>) {
    let ended = match spinner {
        Ok(spinner) => spinner.spin().await.map_err(|e| e.to_string()),
        Err(e) => Err(e.to_string()),
    };
    if let Err(reason) = ended {
        tracing::warn!("this node is not kept in the ROS graph: {reason}");
    }
}

fn receive_buffer(settings: &Ros2) -> usize {
    let granted = receive_buffer_max().unwrap_or(RECEIVE_BUFFER_WANTED);
    let wanted = if settings.receive_buffer_bytes == 0 { granted } else { settings.receive_buffer_bytes };
    if let Some(advice) = receive_buffer_advice(wanted.min(granted)) {
        tracing::warn!("{advice}");
    } else if wanted > granted {
        tracing::warn!("camera.source.ros2.receive_buffer_bytes asks for {wanted}, the kernel grants {granted}");
    }
    wanted
}

struct Readers {
    image: Subscription<Image>,
    info: Subscription<CameraInfo>,
    imu: Subscription<Imu>,
    range: Subscription<Range>,
    transforms: Option<Subscription<TfMessage>>,
}

fn subscribe<M: Message>(node: &mut Node, name: &str, reliable: bool, depth: usize) -> Result<Subscription<M>, Error> {
    let qos = QosProfile::subscription_default().history(History::KeepLast { depth });
    let qos = if reliable { qos.reliability_reliable(WhenFull::DEFAULT) } else { qos.reliability_best_effort() };
    subscribe_with(node, name, qos)
}

/// As tf2 listens: what was said once before we came is asked for too, where its sender keeps it.
fn tf_qos(name: &str) -> QosProfile {
    let qos = QosProfile::subscription_default().reliability_reliable(WhenFull::DEFAULT);
    let qos = qos.history(History::KeepLast { depth: TF_DEPTH });
    if name.ends_with("_static") { qos.durability(Durability::TransientLocal) } else { qos }
}

fn subscribe_with<M: Message>(node: &mut Node, name: &str, qos: QosProfile) -> Result<Subscription<M>, Error> {
    let topic = topic::<M>(node, name, &qos).map_err(Error::Settings)?;
    node.create_subscription(&topic, Some(qos))
        .map_err(|e| Error::Lost { source_name: "ros2".into(), reason: format!("{name}: {e}") })
}

/// What a reader gave: a sample with who sent it and its number there, or why there is none.
type Received = Result<(Sample, MessageInfo), ReadError>;

fn samples<'a, M: Message + DeserializeOwned>(
    reader: &'a Subscription<M>,
    sample: fn(M) -> Sample,
) -> Pin<Box<dyn Stream<Item = Received> + 'a>> {
    Box::pin(reader.async_stream().map(move |read| read.map(|(message, info)| (sample(message), info))))
}

/// Every reader is read until it is empty: its history setting does not keep it from serving old frames.
async fn receive(mut node: Node, readers: Readers, sender: Sender, stopped: oneshot::Receiver<()>) {
    let spinning = spin(node.spinner());
    let frame = |image| Sample::Frame(Arc::new(Frame { image, received: clock::now() }));
    let transforms = readers.transforms.as_ref();
    let transforms = transforms.map(|reader| samples(reader, |message| Sample::Transforms(Arc::new(message))));
    let received = stream::select_all(transforms.into_iter().chain([
        samples(&readers.image, frame),
        samples(&readers.info, |info| Sample::Info(Arc::new(info))),
        samples(&readers.imu, |imu| Sample::Imu(Arc::new(imu))),
        samples(&readers.range, |range| Sample::Range(Arc::new(range))),
    ]));
    let delivering = received.take_until(stopped).for_each(|received| {
        deliver(&sender, received);
        future::ready(())
    });
    // The spinner keeps the ROS graph; frames come without it too.
    tokio::pin!(delivering);
    tokio::select! {
        () = spinning => delivering.await,
        () = &mut delivering => {}
    }
}

fn deliver(sender: &Sender, received: Received) {
    match received {
        Ok((sample, info)) => {
            if matches!(sample, Sample::Frame(_)) {
                sender.numbered(info.publisher_gid().to_bytes16(), info.sequence_number());
            }
            sender.put(sample);
        }
        Err(ReadError::Deserialization { reason }) => {
            tracing::debug!("a message is torn: {reason}");
            sender.torn();
        }
        Err(ReadError::Malformed) => sender.torn(),
        Err(why) => sender.fail(Error::Lost { source_name: "ros2".into(), reason: why.to_string() }),
    }
}
