//! What a recording says is true: flow, pan and velocity by stamp, read beside the frames.

use std::{collections::BTreeMap, fs::File, path::Path};

use anyhow::{Context, Result};
use nightflow::{
    camera::mcap::Messages,
    clock::Stamp,
    wire::{self, Image, TwistStamped, Vector3Stamped},
};

const FLOW: &str = "/truth/flow";
const PAN: &str = "/truth/pan";
const VELOCITY: &str = "/truth/velocity";

/// What is true about one frame.
#[derive(Debug, Clone, Default)]
pub struct Truth {
    flow: Option<Image>,
    pan: Option<[f32; 2]>,
    /// m/s, FLU.
    pub velocity: Option<[f64; 3]>,
}

impl Truth {
    /// The true flow on a grid whose cells are `scale` camera pixels wide; every cell takes the nearest true vector.
    pub fn on(&self, [columns, rows]: [usize; 2], scale: [f32; 2]) -> Option<Vec<[f32; 2]>> {
        if let Some(pan) = self.pan {
            return Some(vec![pan; columns * rows]);
        }
        let image = self.flow.as_ref()?;
        let (values, _) = image.data.as_chunks::<4>();
        let (wide, high) = (image.width as usize, image.height as usize);
        if values.len() != 2 * wide * high || wide * high == 0 {
            return None;
        }
        // Both rasters lie over the same camera frame.
        let camera = [columns as f32 * scale[0], rows as f32 * scale[1]];
        let true_cell = |cell: usize, axis: usize, count: usize| {
            let pixel = (cell as f32 + 0.5) * scale[axis];
            ((pixel / camera[axis] * count as f32) as usize).min(count - 1)
        };
        let vectors = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row))).map(|(column, row)| {
            let at = 2 * (true_cell(row, 1, high) * wide + true_cell(column, 0, wide));
            [f32::from_le_bytes(values[at]), f32::from_le_bytes(values[at + 1])]
        });
        Some(vectors.collect())
    }
}

/// The truths of a recording, in the order of their stamps.
pub struct Truths {
    messages: Messages<File>,
    waiting: BTreeMap<Stamp, Truth>,
}

impl Truths {
    /// Opens the recording a second time, beside whoever reads its frames.
    pub fn open(path: &Path) -> Result<Truths> {
        let messages = Messages::open(path).with_context(|| path.display().to_string())?;
        Ok(Truths { messages, waiting: BTreeMap::new() })
    }

    /// What is true about the frame of this stamp; stamps have to rise.
    pub fn at(&mut self, stamp: Stamp) -> Result<Truth> {
        // The truths of one frame stand together, so the first of a later frame ends them.
        while self.waiting.keys().next_back().is_none_or(|newest| *newest <= stamp) {
            if !self.read_on()? {
                break;
            }
        }
        self.waiting = self.waiting.split_off(&stamp);
        Ok(self.waiting.get(&stamp).cloned().unwrap_or_default())
    }

    /// Keeps the next message of a truth topic; false at the end.
    fn read_on(&mut self) -> Result<bool> {
        for message in self.messages.by_ref() {
            match message.channel.topic.as_str() {
                FLOW => {
                    let image: Image = wire::decode(&message.data)?;
                    let stamp = image.header.stamp.into();
                    self.waiting.entry(stamp).or_default().flow = (image.encoding == "32FC2").then_some(image);
                }
                PAN => {
                    let Vector3Stamped { header, vector } = wire::decode(&message.data)?;
                    self.waiting.entry(header.stamp.into()).or_default().pan = Some([vector.x as f32, vector.y as f32]);
                }
                VELOCITY => {
                    let TwistStamped { header, twist } = wire::decode(&message.data)?;
                    let linear = twist.linear;
                    self.waiting.entry(header.stamp.into()).or_default().velocity =
                        Some([linear.x, linear.y, linear.z]);
                }
                _ => continue,
            }
            return Ok(true);
        }
        Ok(false)
    }
}
