//! `tf2_msgs`: where frames of reference stand in each other.

use serde::{Deserialize, Serialize};

use super::{Message, TransformStamped};

/// `tf2_msgs/TFMessage`: some edges of the tree of frames; `/tf_static` and `/tf` carry it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct TfMessage {
    /// A child frame appears once in the tree.
    pub transforms: Vec<TransformStamped>,
}

impl Message for TfMessage {
    const PACKAGE: &'static str = "tf2_msgs";
    const NAME: &'static str = "TFMessage";
}
