//! The YAML that rosbag2 keeps inside MCAP files: the offered quality of service and the bag's own metadata.

use std::{collections::BTreeMap, fmt::Write};

use super::writer::Topic;
use crate::clock::Stamp;

/// Version of rosbag2's metadata as of Jazzy: policies by name, type hashes, the distribution.
const VERSION: u32 = 9;

/// Images, gyro and range keep what sensors offer; all else is small or rare enough to be offered reliably.
pub(super) fn offered_qos(definition: &str) -> String {
    let (depth, reliability, durability) = match definition {
        "sensor_msgs/msg/Image" | "sensor_msgs/msg/Imu" | "sensor_msgs/msg/Range" => (5, "best_effort", "volatile"),
        // Who comes late must hear it too.
        "tf2_msgs/msg/TFMessage" => (100, "reliable", "transient_local"),
        _ => (10, "reliable", "volatile"),
    };
    let forever = |name: &str| format!("  {name}:\n    sec: 9223372036\n    nsec: 854775807\n");
    format!(
        "- history: keep_last\n  depth: {depth}\n  reliability: {reliability}\n  durability: {durability}\n{}{}  \
         liveliness: automatic\n{}  avoid_ros_namespace_conventions: false\n",
        forever("deadline"),
        forever("lifespan"),
        forever("liveliness_lease_duration"),
    )
}

/// What `ros2 bag info` shows of a file without opening its chunks.
pub(super) fn bag_metadata(file: &str, topics: &BTreeMap<String, Topic>, span: Option<(Stamp, Stamp)>) -> String {
    let (start, duration) = span.map_or((0, 0), |(first, last)| (first.ns().max(0), last.ns() - first.ns().max(0)));
    let messages: u64 = topics.values().map(|topic| topic.messages).sum();
    let begins = format!("nanoseconds_since_epoch: {start}");
    let mut yaml = format!(
        "version: {VERSION}\nstorage_identifier: mcap\nduration:\n  nanoseconds: {duration}\nstarting_time:\n  {begins}\n\
         message_count: {messages}\ntopics_with_message_count:"
    );
    if topics.is_empty() {
        yaml += " []";
    }
    yaml += "\n";
    for (name, topic) in topics {
        // Writing into a String cannot fail.
        let _ = write!(
            yaml,
            "  - topic_metadata:\n      name: {}\n      type: {}\n      serialization_format: cdr\n      \
             offered_qos_profiles: {}\n      type_description_hash: {}\n    message_count: {}\n",
            quoted(name),
            topic.definition,
            quoted(&topic.qos),
            topic.hash,
            topic.messages
        );
    }
    let file = quoted(file);
    let _ = write!(
        yaml,
        "compression_format: \"\"\ncompression_mode: \"\"\nrelative_file_paths:\n  - {file}\nfiles:\n  - path: {file}\n    \
         starting_time:\n      {begins}\n    duration:\n      nanoseconds: {duration}\n    \
         message_count: {messages}\ncustom_data: ~\nros_distro: jazzy\n",
    );
    yaml
}

/// A YAML string in double quotes.
fn quoted(text: &str) -> String {
    let mut out = String::with_capacity(text.len() + 2);
    out.push('"');
    for c in text.chars() {
        match c {
            '"' => out.push_str("\\\""),
            '\\' => out.push_str("\\\\"),
            '\n' => out.push_str("\\n"),
            c if c.is_control() => {
                let _ = write!(out, "\\x{:02x}", c as u32);
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sensors_are_best_effort_and_our_own_reliable() {
        assert!(offered_qos("sensor_msgs/msg/Image").contains("depth: 5\n  reliability: best_effort\n"));
        assert!(
            offered_qos("nightflow_msgs/msg/Step")
                .contains("depth: 10\n  reliability: reliable\n  durability: volatile")
        );
        assert!(offered_qos("tf2_msgs/msg/TFMessage").contains("durability: transient_local\n"));
    }

    #[test]
    fn yaml_strings_keep_their_line_breaks() {
        assert_eq!(quoted("- a: \"b\"\n"), r#""- a: \"b\"\n""#);
    }
}
