//! The names that rmw_zenoh gives to what it sends: data keys, tokens of the ROS graph, attachments.

use super::{Message, dds_name, type_hash};

/// Bytes of an attachment as it is written today.
pub const ATTACHMENT_BYTES: usize = 33;

/// Reliable, volatile, keep the last ten: what publishers offer.
pub const QOS_RELIABLE: &str = "::,10:,:,:,,";
/// Best effort, volatile, keep the last five: what readers of sensors ask for.
pub const QOS_SENSOR: &str = "2::,5:,:,:,,";
/// Reliable, transient local, keep the last hundred: what readers of `/tf_static` ask for.
pub const QOS_KEPT: &str = ":1:,100:,:,:,,";

/// A plain key: the topic without its first slash.
pub fn plain_key(topic: &str) -> &str {
    topic.trim_matches('/')
}

/// Where messages of a topic travel: `<domain>/<topic>/<type>/<hash>`.
pub fn data_key<M: Message>(domain: u16, topic: &str) -> String {
    format!("{domain}/{}/{}/{}", plain_key(topic), dds_name::<M>(), type_hash::<M>())
}

/// [`data_key`] for any hash: releases of ROS 2 differ in it, Humble has none.
pub fn any_hash_key<M: Message>(domain: u16, topic: &str) -> String {
    format!("{domain}/{}/{}/*", plain_key(topic), dds_name::<M>())
}

/// Which way an endpoint goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Endpoint {
    /// Messages go out.
    Publisher,
    /// Messages come in.
    Subscription,
}

/// A node of the ROS graph within one zenoh session.
#[derive(Debug, Clone)]
pub struct Node {
    /// ROS domain.
    pub domain: u16,
    /// The zenoh session.
    pub session: String,
    /// The node's name, in the root namespace.
    pub name: String,
}

impl Node {
    /// The liveliness key that shows the node in the graph.
    pub fn token(&self) -> String {
        format!("@ros2_lv/{}/{}/0/0/NN/%/%/{}", self.domain, self.session, self.name)
    }

    /// The liveliness key that shows one of its endpoints; `id` differs for each of the session's, and none has 0.
    pub fn endpoint_token<M: Message>(&self, id: u64, endpoint: Endpoint, topic: &str, qos: &str) -> String {
        let kind = match endpoint {
            Endpoint::Publisher => "MP",
            Endpoint::Subscription => "MS",
        };
        let Self { domain, session, name } = self;
        let (kind_of_message, hash) = (dds_name::<M>(), type_hash::<M>());
        let topic = format!("/{}", plain_key(topic)).replace('/', "%");
        format!("@ros2_lv/{domain}/{session}/0/{id}/{kind}/%/%/{name}/{topic}/{kind_of_message}/{hash}/{qos}")
    }
}

/// What rmw_zenoh tells of a message beside it; its subscribers refuse a message without.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attachment {
    /// Counts the publisher's messages from 1.
    pub sequence: i64,
    /// When it was sent, ns since the epoch.
    pub source_ns: i64,
    /// The publisher.
    pub gid: [u8; 16],
}

impl Attachment {
    /// Little-endian sequence and time, then the publisher with its length.
    pub fn to_bytes(&self) -> [u8; ATTACHMENT_BYTES] {
        let mut bytes = [0; ATTACHMENT_BYTES];
        bytes[..8].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.source_ns.to_le_bytes());
        bytes[16] = 16;
        bytes[17..].copy_from_slice(&self.gid);
        bytes
    }

    /// Reads today's form, and the one before rmw_zenoh 0.2.4 in which every field has its name before it.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        Self::fields(bytes, ["", "", ""])
            .or_else(|| Self::fields(bytes, ["\x0fsequence_number", "\x10source_timestamp", "\x0asource_gid"]))
    }

    fn fields(bytes: &[u8], labels: [&str; 3]) -> Option<Self> {
        let (sequence, rest) = bytes.strip_prefix(labels[0].as_bytes())?.split_first_chunk()?;
        let (source_ns, rest) = rest.strip_prefix(labels[1].as_bytes())?.split_first_chunk()?;
        let gid = rest.strip_prefix(labels[2].as_bytes())?.strip_prefix(&[16])?;
        Some(Self {
            sequence: i64::from_le_bytes(*sequence),
            source_ns: i64::from_le_bytes(*source_ns),
            gid: gid.try_into().ok()?,
        })
    }
}

/// A publisher's identity: the hash of its token, low half first.
pub fn gid(endpoint_token: &str) -> [u8; 16] {
    xxhash_rust::xxh3::xxh3_128(endpoint_token.as_bytes()).to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Image;

    const HASH: &str = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47";

    #[test]
    fn keys_and_tokens_are_those_of_rmw_zenoh() {
        let node = Node { domain: 3, session: "aac3178e".into(), name: "nightflow".into() };
        assert_eq!(node.token(), "@ros2_lv/3/aac3178e/0/0/NN/%/%/nightflow");
        assert_eq!(
            node.endpoint_token::<Image>(10, Endpoint::Publisher, "/camera/image_raw", QOS_RELIABLE),
            format!(
                "@ros2_lv/3/aac3178e/0/10/MP/%/%/nightflow/%camera%image_raw/sensor_msgs::msg::dds_::Image_/{HASH}/::,10:,:,:,,"
            )
        );
        assert_eq!(
            data_key::<Image>(3, "/camera/image_raw"),
            format!("3/camera/image_raw/sensor_msgs::msg::dds_::Image_/{HASH}")
        );
    }

    #[test]
    fn attachments_are_read_in_both_forms() {
        let attachment = Attachment { sequence: 7, source_ns: -5, gid: std::array::from_fn(|i| i as u8) };
        let bytes = attachment.to_bytes();
        assert_eq!(Attachment::from_bytes(&bytes), Some(attachment));
        let mut labelled = b"\x0fsequence_number".to_vec();
        labelled.extend_from_slice(&bytes[..8]);
        labelled.extend_from_slice(b"\x10source_timestamp");
        labelled.extend_from_slice(&bytes[8..16]);
        labelled.extend_from_slice(b"\x0asource_gid");
        labelled.extend_from_slice(&bytes[16..]);
        assert_eq!(labelled.len(), 77);
        assert_eq!(Attachment::from_bytes(&labelled), Some(attachment));
        for short in 0..bytes.len() {
            assert_eq!(Attachment::from_bytes(&bytes[..short]), None);
        }
        assert_eq!(Attachment::from_bytes(&labelled[..76]), None);
    }
}
