//! Puts samples and results down in the order in which the pipeline saw them, under times that never go back.

use super::{
    Error, Writer,
    queue::{Item, StepItem},
};
use crate::{
    camera::{self, Sample},
    clock::Stamp,
    publish::outgoing,
    wire::{Image, Message, Status},
};

/// A small sample's own stamp is taken as its log time when it is at most this far ahead of what came before it;
/// beyond that its clock is another one than ours.
const AHEAD_NS_MAX: i64 = 1_000_000_000;

/// The names under which things are kept.
#[derive(Debug, Clone)]
pub(super) struct Topics {
    image: String,
    info: String,
    imu: String,
    range: String,
    transforms: String,
    width: String,
    step: String,
    ego_motion: String,
    velocity: String,
    proximity: String,
    flow: String,
    flow_confidence: String,
    status: String,
}

impl Topics {
    pub(super) fn new(cameras: &camera::Config, namespace: &str) -> Self {
        let under = |name: &str| format!("{}/{name}", namespace.trim_end_matches('/'));
        Self {
            image: cameras.image_topic.clone(),
            info: cameras.info_topic.clone(),
            imu: cameras.imu_topic.clone(),
            range: cameras.range_topic.clone(),
            transforms: cameras.tf_topic.clone(),
            width: cameras.width_topic.clone(),
            step: under("step"),
            ego_motion: under("ego_motion"),
            velocity: under("velocity"),
            proximity: under("proximity"),
            flow: under("flow"),
            flow_confidence: under("flow_confidence"),
            status: under("status"),
        }
    }
}

/// Writes items; the file's order is theirs.
pub(super) struct Pen {
    writer: Writer,
    topics: Topics,
    flow: bool,
    last: Option<Stamp>,
    image: Image,
}

impl Pen {
    pub(super) fn new(writer: Writer, topics: Topics, flow: bool) -> Self {
        Self { writer, topics, flow, last: None, image: Image::default() }
    }

    /// Writes an item before which `lost` of its kind found no room.
    pub(super) fn write(&mut self, item: &Item, lost: u32) -> Result<(), Error> {
        match item {
            Item::Sample(sample) => self.sample(sample, lost),
            Item::Step(step) => self.step(step, lost),
            Item::Status(status) => self.status(status, lost),
        }
    }

    pub(super) fn sync(&mut self) -> Result<(), Error> {
        self.writer.sync()
    }

    pub(super) fn finish(self) -> Result<(), Error> {
        self.writer.finish()
    }

    fn sample(&mut self, sample: &Sample, lost: u32) -> Result<(), Error> {
        let stamp = sample.stamp();
        let time = match sample {
            Sample::Frame(frame) => self.not_before(frame.received),
            _ => self.near(stamp),
        };
        let writer = &mut self.writer;
        match sample {
            Sample::Frame(frame) => put(writer, &self.topics.image, lost, time, stamp, &frame.image),
            Sample::Info(info) => put(writer, &self.topics.info, lost, time, stamp, &**info),
            Sample::Imu(imu) => put(writer, &self.topics.imu, lost, time, stamp, &**imu),
            Sample::Range(range) => put(writer, &self.topics.range, lost, time, stamp, &**range),
            Sample::Transforms(message) => put(writer, &self.topics.transforms, lost, time, stamp, &**message),
            Sample::Width(width) => put(writer, &self.topics.width, lost, time, stamp, &**width),
        }
    }

    fn step(&mut self, item: &StepItem, lost: u32) -> Result<(), Error> {
        let stamp = item.step.header.stamp.into();
        let time = self.near(stamp);
        let (writer, topics) = (&mut self.writer, &self.topics);
        put(writer, &topics.step, lost, time, stamp, &item.step)?;
        if item.has_motion {
            put(writer, &topics.ego_motion, 0, time, stamp, &item.motion)?;
        }
        if item.has_twist {
            put(writer, &topics.velocity, 0, time, stamp, &item.twist)?;
        }
        if item.has_proximity {
            put(writer, &topics.proximity, 0, time, stamp, &item.proximity)?;
        }
        if self.flow {
            let flow = item.flow.flow();
            outgoing::flow_image(&item.flow.frame_id, &flow, &mut self.image);
            put(writer, &topics.flow, lost, time, stamp, &self.image)?;
            outgoing::confidence_image(&item.flow.frame_id, &flow, &mut self.image);
            put(writer, &topics.flow_confidence, lost, time, stamp, &self.image)?;
        }
        Ok(())
    }

    fn status(&mut self, status: &Status, lost: u32) -> Result<(), Error> {
        let stamp = status.header.stamp.into();
        let time = self.near(stamp);
        put(&mut self.writer, &self.topics.status, lost, time, stamp, status)
    }

    fn not_before(&mut self, time: Stamp) -> Stamp {
        let time = self.last.map_or(time, |last| last.max(time));
        self.last = Some(time);
        time
    }

    /// A log time for what carries no time of arrival.
    fn near(&mut self, stamp: Stamp) -> Stamp {
        match self.last {
            Some(last) if stamp.ns().saturating_sub(last.ns()) > AHEAD_NS_MAX => last,
            _ => self.not_before(stamp),
        }
    }
}

fn put<M: Message>(
    writer: &mut Writer,
    topic: &str,
    lost: u32,
    log_time: Stamp,
    publish_time: Stamp,
    message: &M,
) -> Result<(), Error> {
    writer.skip(topic, lost);
    writer.write(topic, log_time, publish_time, message)
}
