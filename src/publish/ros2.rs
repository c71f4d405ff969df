//! Results over DDS, as ROS 2 nodes read them.

use std::thread::JoinHandle;

use ros2_client::{
    QosProfile,
    dds::{Node, Publisher},
    qos::{History, WhenFull},
};

use super::{
    Config, Error, Ros2,
    courier::{Courier, Message, Network, Topics},
};
use crate::{
    camera::ros2 as dds,
    wire::{self, DiagnosticArray, EgoMotion, Image, LaserScan, Status, Step, TwistWithCovarianceStamped},
};

const NAME: &str = "ros2";
/// Only discovery and acknowledgements come in here.
pub(super) const ACK_BUFFER: usize = 1 << 20;
/// What a reliable reader may miss and still be sent again.
const DEPTH: usize = 10;

/// Joins the domain and offers every topic, reliably, which serves best-effort readers too.
pub fn open(config: &Config, settings: &Ros2) -> Result<Courier, Error> {
    let network = Dds::join(config, settings).map_err(|reason| Error::Open { sink: NAME, reason })?;
    Courier::open(NAME, config, network)
}

struct Dds {
    velocity: Publisher<TwistWithCovarianceStamped>,
    ego_motion: Publisher<EgoMotion>,
    proximity: Publisher<LaserScan>,
    step: Publisher<Step>,
    status: Publisher<Status>,
    diagnostics: Publisher<DiagnosticArray>,
    flow: Publisher<Image>,
    confidence: Publisher<Image>,
    preview: Publisher<Image>,
    node: Option<Node>,
    spinning: Option<JoinHandle<()>>,
}

impl Dds {
    fn join(config: &Config, settings: &Ros2) -> Result<Self, String> {
        let topics = Topics::of(config);
        let mut node = dds::join(settings.domain, "nightflow", ACK_BUFFER)?;
        let spinner = node.spinner();
        Ok(Self {
            velocity: publisher(&mut node, &topics.velocity)?,
            ego_motion: publisher(&mut node, &topics.ego_motion)?,
            proximity: publisher(&mut node, &topics.proximity)?,
            step: publisher(&mut node, &topics.step)?,
            status: publisher(&mut node, &topics.status)?,
            diagnostics: publisher(&mut node, &topics.diagnostics)?,
            flow: publisher(&mut node, &topics.flow)?,
            confidence: publisher(&mut node, &topics.confidence)?,
            preview: publisher(&mut node, &topics.preview)?,
            node: Some(node),
            spinning: std::thread::Builder::new()
                .name("publish-ros2-graph".into())
                .spawn(move || dds::on_tokio(dds::spin(spinner)))
                .ok(),
        })
    }
}

impl Network for Dds {
    fn send(&mut self, message: Message<'_>) -> Result<(), String> {
        match message {
            Message::Velocity(message) => publish(&self.velocity, message),
            Message::EgoMotion(message) => publish(&self.ego_motion, message),
            Message::Proximity(message) => publish(&self.proximity, message),
            Message::Step(message) => publish(&self.step, message),
            Message::Status(message) => publish(&self.status, message),
            Message::Diagnostics(message) => publish(&self.diagnostics, message),
            Message::Flow(message) => publish(&self.flow, message),
            Message::Confidence(message) => publish(&self.confidence, message),
            Message::Preview(message) => publish(&self.preview, message),
        }
    }
}

impl Drop for Dds {
    fn drop(&mut self) {
        // The spinner ends with its node.
        drop(self.node.take());
        if let Some(spinning) = self.spinning.take() {
            let _ = spinning.join();
        }
    }
}

pub(super) fn publisher<M: wire::Message>(node: &mut Node, name: &str) -> Result<Publisher<M>, String> {
    let qos = QosProfile::publisher_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .history(History::KeepLast { depth: DEPTH });
    let topic = dds::topic::<M>(node, name, &qos)?;
    node.create_publisher(&topic, Some(qos)).map_err(|e| format!("{name}: {e}"))
}

pub(super) fn publish<M: wire::Message + Clone>(publisher: &Publisher<M>, message: &M) -> Result<(), String> {
    publisher.publish(message.clone()).map_err(|why| format!("{}: {why}", wire::ros_name::<M>()))
}
