//! How the camera sits on the vehicle, out of the transforms that other nodes publish.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use super::Error;
use crate::wire::{TfMessage, TransformStamped};

/// Frames between camera and root at most; more are a ring.
const DEPTH_MAX: usize = 64;
/// Frames that are remembered at most: a vehicle's have some dozens.
const FRAMES_MAX: usize = 1024;

/// A child frame in its parent.
#[derive(Debug, Clone)]
struct Edge {
    child: String,
    parent: String,
    /// Brings points of the child into the parent.
    stands: Isometry3<f64>,
}

/// The tree of frames as far as it was told, and the two of them that matter.
#[derive(Debug, Clone, Default)]
pub(super) struct Mounting {
    body: String,
    camera: String,
    edges: Vec<Edge>,
}

impl Mounting {
    /// The vehicle's own frame.
    pub(super) fn body(&mut self, frame: &str) {
        self.body = bare(frame).to_owned();
    }

    /// The camera's optical frame; true when it is another one than before.
    pub(super) fn camera(&mut self, frame: &str) -> bool {
        let new = self.camera != bare(frame);
        if new {
            self.camera = bare(frame).to_owned();
        }
        new
    }

    /// Takes edges of the tree. One that makes no sense is refused after the others were taken.
    pub(super) fn keep(&mut self, message: &TfMessage) -> Result<(), Error> {
        let mut refused = None;
        for transform in &message.transforms {
            match stands(transform) {
                Some(stands) => self.edge(transform, stands),
                None => refused = Some(transform),
            }
        }
        match refused {
            None => Ok(()),
            Some(wrong) => {
                let stamp = wrong.header.stamp.into();
                Err(Error::NotFinite { sensor: "transform", stamp, what: "a translation or a unit rotation" })
            }
        }
    }

    fn edge(&mut self, transform: &TransformStamped, stands: Isometry3<f64>) {
        let (child, parent) = (bare(&transform.child_frame_id), bare(&transform.header.frame_id));
        let room = self.edges.len() < FRAMES_MAX;
        match self.edges.iter_mut().find(|edge| edge.child == child) {
            Some(edge) if edge.parent == parent => edge.stands = stands,
            Some(edge) => (edge.parent, edge.stands) = (parent.to_owned(), stands),
            None if room => {
                self.edges.push(Edge { child: child.to_owned(), parent: parent.to_owned(), stands });
            }
            None => {}
        }
    }

    /// Brings points of the camera's optical frame into the body's, where the tree joins them.
    pub(super) fn find(&self) -> Option<Isometry3<f64>> {
        if self.camera.is_empty() {
            return None;
        }
        let (mut frame, mut up) = (self.camera.as_str(), Isometry3::identity());
        for _ in 0..DEPTH_MAX {
            if let Some(down) = self.above_body(frame) {
                return Some(down.inverse() * up);
            }
            let edge = self.edges.iter().find(|edge| edge.child == frame)?;
            (frame, up) = (&edge.parent, edge.stands * up);
        }
        None
    }

    /// Brings points of the body into `ancestor`, if it is one.
    fn above_body(&self, ancestor: &str) -> Option<Isometry3<f64>> {
        let (mut frame, mut up) = (self.body.as_str(), Isometry3::identity());
        for _ in 0..DEPTH_MAX {
            if frame == ancestor {
                return Some(up);
            }
            let edge = self.edges.iter().find(|edge| edge.child == frame)?;
            (frame, up) = (&edge.parent, edge.stands * up);
        }
        None
    }
}

/// Names of frames had a slash before them once.
fn bare(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

fn stands(transform: &TransformStamped) -> Option<Isometry3<f64>> {
    let (t, q) = (transform.transform.translation, transform.transform.rotation);
    let rotation = Quaternion::new(q.w, q.x, q.y, q.z);
    let right = [t.x, t.y, t.z].iter().all(|value| value.is_finite()) && (0.9..1.1).contains(&rotation.norm());
    right.then(|| Isometry3::from_parts(Translation3::new(t.x, t.y, t.z), UnitQuaternion::from_quaternion(rotation)))
}
