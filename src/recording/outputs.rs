//! What a recording says came out: its output messages as bytes, for comparing with a replay.

use std::{collections::BTreeMap, fs::File, path::Path, sync::Arc};

use super::Error;
use crate::{
    camera::mcap::{Messages, Tear, files},
    clock::Stamp,
};

/// Topics below the namespace that depend on the recorded samples alone; status also depends on the clock.
pub(super) const TOPICS: [&str; 6] = ["step", "ego_motion", "velocity", "proximity", "flow", "flow_confidence"];

/// One recorded output.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    /// The topic, namespace and all.
    pub topic: String,
    /// The stamp in the message's header.
    pub stamp: Stamp,
    /// `nightflow_msgs/msg/Step`.
    pub definition: Arc<str>,
    /// The message's `ros2msg` text, with dependencies.
    pub text: Arc<str>,
    /// The message.
    pub cdr: Vec<u8>,
}

/// Iterates over the outputs in the order in which they were written.
pub struct Outputs {
    messages: Messages<File>,
    namespace: String,
    schemas: BTreeMap<u16, (Arc<str>, Arc<str>)>,
}

impl Outputs {
    /// Opens a recording; outputs are the topics under `namespace`, as in `/nightflow`.
    pub fn open(path: &Path, namespace: &str) -> Result<Self, Error> {
        let messages = Messages::open(path).map_err(|source| Error::Io { path: path.into(), source })?;
        if let Some(tear) = messages.tear() {
            return Err(Error::Unreadable { path: path.into(), reason: tear.reason.clone() });
        }
        Ok(Self { messages, namespace: namespace.trim_end_matches('/').into(), schemas: BTreeMap::new() })
    }

    /// Where the file is torn; known at the end.
    pub fn tear(&self) -> Option<&Tear> {
        self.messages.tear()
    }
}

impl Iterator for Outputs {
    type Item = Output;

    fn next(&mut self) -> Option<Output> {
        loop {
            let message = self.messages.next()?;
            let topic = &message.channel.topic;
            let ours = topic
                .strip_prefix(self.namespace.as_str())
                .and_then(|rest| rest.strip_prefix('/'))
                .is_some_and(|name| TOPICS.contains(&name));
            if !ours {
                continue;
            }
            let schema = message.channel.schema.as_ref();
            let (definition, text) = self
                .schemas
                .entry(schema.map_or(0, |schema| schema.id))
                .or_insert_with(|| {
                    let name = schema.map_or("", |schema| &schema.name);
                    let text = schema.map_or("".into(), |schema| String::from_utf8_lossy(&schema.data));
                    (name.into(), text.as_ref().into())
                })
                .clone();
            let cdr = message.data.into_owned();
            return Some(Output { topic: topic.clone(), stamp: stamp_of(&cdr), definition, text, cdr });
        }
    }
}

/// The stamp at the front of a message that begins with a header; 0 for one that is too short.
pub(super) fn stamp_of(cdr: &[u8]) -> Stamp {
    match cdr {
        [_, _, _, _, a, b, c, d, e, f, g, h, ..] => {
            let (sec, nanosec) = (i32::from_le_bytes([*a, *b, *c, *d]), u32::from_le_bytes([*e, *f, *g, *h]));
            crate::wire::Time { sec, nanosec }.into()
        }
        _ => Stamp::default(),
    }
}

/// The entries of the newest metadata record of this name, as in `nightflow` for the settings that a recording was
/// made with. Of a folder of rosbag2, what its first file says.
pub fn metadata(path: &Path, name: &str) -> Result<Option<BTreeMap<String, String>>, Error> {
    let io = |source| Error::Io { path: path.into(), source };
    let Some(file) = files(path).map_err(io)?.into_iter().next() else { return Ok(None) };
    let mut messages = Messages::open(&file).map_err(io)?;
    // Ours stands before the first message; only a file that has none there is read on.
    let mut first = true;
    while messages.next().is_some() {
        if first && let Some(found) = newest(&messages, name) {
            return Ok(Some(found));
        }
        first = false;
    }
    Ok(newest(&messages, name))
}

fn newest(messages: &Messages<File>, name: &str) -> Option<BTreeMap<String, String>> {
    messages.metadata().iter().rev().find(|record| record.name == name).map(|record| record.metadata.clone())
}
