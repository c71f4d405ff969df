//! A frame that is kept for a while, and the flow from it to newer ones by their gradients alone, from where it is known to lead.
//!
//! Between two frames that follow each other a camera hardly moves, and what vectors are off by counts for much. Between frames a
//! second apart it counts for a thirtieth of that. No network is needed where it is known to a pixel where everything went.

use super::{
    Flow, Gradients, Grid,
    matcher::{confide, mask, quarter},
    refine::Refiner,
};
use crate::exposure::{Exposed, Pair};

/// Light that changed by more than this factor is another lamp's: frames under different lamps are not alike.
const LIGHT_MAX: f32 = 1.5;
/// How far off what is expected may be, pixels of the image: a gyro's bias over a second.
const EXPECTED: f32 = 0.5;

/// A frame that is kept.
#[derive(Debug, Default)]
pub struct Keyframe {
    frame: Exposed,
    kept: bool,
    refiner: Refiner,
    vectors: Vec<f32>,
    confidence: Vec<f32>,
}

impl Keyframe {
    /// Keeps a frame instead of the one before. It takes memory for the first of a size only.
    pub fn keep(&mut self, frame: &Exposed) {
        let Exposed { mut rgb, mut linear, mut saturated, .. } = std::mem::take(&mut self.frame);
        copy(&frame.rgb, &mut rgb);
        copy(&frame.linear, &mut linear);
        copy(&frame.saturated, &mut saturated);
        self.frame = Exposed { rgb, linear, saturated, frame_id: frame.frame_id.clone(), ..*frame };
        self.kept = true;
    }

    /// Flow to a newer frame, at a quarter of its resolution, and what the gradients say of it. `expect` fills in by how many camera
    /// pixels (right, down) what was seen in a cell has moved, NaN where that can't be said, to within half a pixel or so of the image.
    /// `None` where there is no frame, or one that is not like this, or nothing is expected.
    pub fn flow(
        &mut self,
        newer: &Exposed,
        expect: &mut dyn FnMut(&Grid, &mut Vec<f32>) -> Option<()>,
    ) -> Option<(Flow<'_>, Gradients<'_>)> {
        self.kept &= comparable(&self.frame, newer);
        if !self.kept {
            return None;
        }
        self.light(newer);
        let grid = quarter(newer);
        expect(&grid, &mut self.vectors)?;
        if self.vectors.len() != 2 * grid.cells() {
            return None;
        }
        self.confidence.clear();
        self.confidence.resize(grid.cells(), EXPECTED);
        let pair = Pair { older: &self.frame, newer, gain_step: None };
        if !self.refiner.refine(&pair, grid.width, &mut self.vectors, &mut self.confidence) {
            return None;
        }
        confide(&mut self.confidence);
        mask(&pair, &grid, &self.vectors, &mut self.confidence);
        let (older, newer) = (self.frame.stamp, newer.stamp);
        Some((Flow { older, newer, grid, vectors: &self.vectors, confidence: &self.confidence }, self.refiner.said()))
    }

    /// Brings the kept frame to the brightness that the newer one has.
    fn light(&mut self, newer: &Exposed) {
        let gain = match self.frame.linear.is_empty() {
            true => self.frame.gain,
            false => newer.gain * newer.raw_mean / self.frame.raw_mean,
        };
        if gain != self.frame.gain {
            self.frame.gain = gain;
            // Its grey is another one now.
            self.frame.generation = newer.generation;
        }
    }
}

/// Whether two frames can be compared.
fn comparable(kept: &Exposed, newer: &Exposed) -> bool {
    let light = newer.raw_mean / kept.raw_mean;
    let raw = !kept.linear.is_empty() && !newer.linear.is_empty();
    kept.like(newer) && (1.0 / LIGHT_MAX..=LIGHT_MAX).contains(&light) && (raw || kept.gain == newer.gain)
}

fn copy<T: Copy>(from: &[T], to: &mut Vec<T>) {
    to.clear();
    to.extend_from_slice(from);
}
