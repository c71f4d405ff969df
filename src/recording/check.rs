//! Compares what a replay gives with what was recorded, to the byte.

use std::{iter::Peekable, path::Path};

use super::{
    Error,
    fields::first_difference,
    outputs::{Output, Outputs, TOPICS},
    queue::StepItem,
};
use crate::{
    clock::Stamp,
    publish::{self, Offer, Sink, outgoing},
    wire::{self, Image, Message},
};

/// What was found equal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Checked {
    /// Messages that are equal to the byte.
    pub equal: u64,
    /// Steps of the replay that the recording lacks, because the disk was too slow for them.
    pub holes: u64,
}

/// The first output that differs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{topic} at {stamp}: {what}")]
pub struct Difference {
    /// The output's topic.
    pub topic: String,
    /// Its stamp.
    pub stamp: Stamp,
    /// The value that differs, recorded ≠ replayed, or which side has none.
    pub what: String,
}

/// Compares two sequences of outputs.
pub fn compare(
    recorded: impl Iterator<Item = Output>,
    replayed: impl Iterator<Item = Output>,
) -> Result<Checked, Difference> {
    let mut comparison = Comparison::new(recorded);
    for output in replayed {
        comparison.take(&output.topic, output.stamp, &output.cdr)?;
    }
    comparison.end()
}

/// A sink that compares each step with the recording that it is a replay of.
pub struct Check {
    comparison: Comparison<Outputs>,
    topics: [String; TOPICS.len()],
    body_frame: String,
    item: StepItem,
    image: Image,
    cdr: Vec<u8>,
    difference: Option<Difference>,
}

impl Check {
    /// Opens the recording; `namespace` and `body_frame` are those that it was made with.
    pub fn open(path: &Path, namespace: &str, body_frame: &str) -> Result<Self, Error> {
        Ok(Self {
            comparison: Comparison::new(Outputs::open(path, namespace)?),
            topics: TOPICS.map(|topic| format!("{}/{topic}", namespace.trim_end_matches('/'))),
            body_frame: body_frame.into(),
            item: StepItem::default(),
            image: Image::default(),
            cdr: Vec::new(),
            difference: None,
        })
    }

    /// The first difference so far.
    pub fn difference(&self) -> Option<&Difference> {
        self.difference.as_ref()
    }

    /// The result, once the replay has ended. A recording with outputs that the replay did not give differs too.
    pub fn verdict(self) -> Result<Checked, Difference> {
        match self.difference {
            Some(difference) => Err(difference),
            None => self.comparison.end(),
        }
    }

    fn compare(&mut self, offer: &Offer<'_>) -> Result<(), Stop> {
        self.item.keep(offer, &self.body_frame, true);
        let (item, stamp) = (&self.item, offer.moved.newer);
        let mut take = |rank: usize, cdr: &[u8]| self.comparison.take(&self.topics[rank], stamp, cdr);
        take(0, encoded(&item.step, &mut self.cdr)?)?;
        if item.has_motion {
            take(1, encoded(&item.motion, &mut self.cdr)?)?;
        }
        if item.has_twist {
            take(2, encoded(&item.twist, &mut self.cdr)?)?;
        }
        if item.has_proximity {
            take(3, encoded(&item.proximity, &mut self.cdr)?)?;
        }
        outgoing::flow_image(&item.flow.frame_id, &offer.flow, &mut self.image);
        take(4, encoded(&self.image, &mut self.cdr)?)?;
        outgoing::confidence_image(&item.flow.frame_id, &offer.flow, &mut self.image);
        Ok(take(5, encoded(&self.image, &mut self.cdr)?)?)
    }
}

enum Stop {
    Differs(Difference),
    Wire(wire::Error),
}

impl From<Difference> for Stop {
    fn from(difference: Difference) -> Self {
        Stop::Differs(difference)
    }
}

fn encoded<'c, M: Message>(message: &M, cdr: &'c mut Vec<u8>) -> Result<&'c [u8], Stop> {
    wire::encode(message, cdr).map_err(Stop::Wire)?;
    Ok(cdr)
}

impl Sink for Check {
    fn name(&self) -> &'static str {
        "check"
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), publish::Error> {
        if self.difference.is_some() {
            return Ok(());
        }
        match self.compare(offer) {
            Ok(()) => Ok(()),
            Err(Stop::Differs(difference)) => {
                self.difference = Some(difference);
                Ok(())
            }
            Err(Stop::Wire(error)) => Err(publish::Error::Lost {
                sink: "check",
                what: format!("step {}", offer.moved.step),
                reason: error.to_string(),
            }),
        }
    }
}

/// Walks through the recorded outputs beside the replayed ones.
struct Comparison<I: Iterator<Item = Output>> {
    recorded: Peekable<I>,
    checked: Checked,
    /// The newest step that both sides have.
    step: Option<Stamp>,
}

impl<I: Iterator<Item = Output>> Comparison<I> {
    fn new(recorded: I) -> Self {
        Self { recorded: recorded.peekable(), checked: Checked::default(), step: None }
    }

    fn take(&mut self, topic: &str, stamp: Stamp, cdr: &[u8]) -> Result<(), Difference> {
        let differs = |topic: &str, stamp, what: String| Err(Difference { topic: topic.into(), stamp, what });
        let place = (stamp, rank(topic));
        match self.recorded.peek() {
            Some(output) if (output.stamp, rank(&output.topic)) == place => {
                if let Some(what) = difference(output, cdr) {
                    return differs(topic, stamp, what);
                }
                self.checked.equal += 1;
                if place.1 == 0 {
                    self.step = Some(stamp);
                }
                self.recorded.next();
                Ok(())
            }
            Some(output) if (output.stamp, rank(&output.topic)) < place => {
                let (topic, stamp) = (output.topic.clone(), output.stamp);
                differs(&topic, stamp, "recorded, but the replay gives none".into())
            }
            _ => match place.1 {
                0 => {
                    self.checked.holes += 1;
                    Ok(())
                }
                // A recording may be without flow; a velocity that is missing beside its step was not there.
                1..=3 if self.step == Some(stamp) => {
                    differs(topic, stamp, "the replay gives one, none was recorded".into())
                }
                _ => Ok(()),
            },
        }
    }

    fn end(mut self) -> Result<Checked, Difference> {
        match self.recorded.next() {
            Some(output) => {
                let what = "recorded, but the replay gives none".into();
                Err(Difference { topic: output.topic, stamp: output.stamp, what })
            }
            None => Ok(self.checked),
        }
    }
}

/// The order in which the outputs of one step are written.
fn rank(topic: &str) -> usize {
    let name = topic.rsplit('/').next().unwrap_or(topic);
    TOPICS.iter().position(|known| *known == name).unwrap_or(TOPICS.len())
}

fn difference(recorded: &Output, replayed: &[u8]) -> Option<String> {
    let what = first_difference(&recorded.definition, &recorded.text, &recorded.cdr, replayed)?;
    if recorded.definition.as_ref() == "sensor_msgs/msg/Image" && what.starts_with("data[") {
        return Some(cell(recorded, replayed).unwrap_or(what));
    }
    Some(what)
}

/// Names a vector by its cell, `flow[row, column].u`, instead of by the byte of the image that it begins at.
fn cell(recorded: &Output, replayed: &[u8]) -> Option<String> {
    let image: Image = wire::decode(&recorded.cdr).ok()?;
    let other: Image = wire::decode(replayed).ok()?;
    let parts: &[&str] = match image.encoding.as_str() {
        "32FC1" => &[""],
        "32FC2" => &[".u", ".v"],
        _ => return None,
    };
    let (floats, others) = (image.data.as_chunks::<4>().0, other.data.as_chunks::<4>().0);
    let at = floats.iter().zip(others).position(|(a, b)| a != b)?;
    let (cell, part) = (at / parts.len(), at % parts.len());
    let width = usize::try_from(image.width).ok().filter(|width| *width > 0)?;
    let name = recorded.topic.rsplit('/').next().unwrap_or(&recorded.topic);
    let (a, b) = (f32::from_le_bytes(floats[at]), f32::from_le_bytes(others[at]));
    Some(format!("{name}[{}, {}]{} {a} ≠ {b}", cell / width, cell % width, parts[part]))
}
