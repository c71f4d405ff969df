//! The first half of developing: one pass over a frame's bytes makes it linear, whatever frame came before it.

use std::sync::Arc;

use super::{
    Config, Error, Exposed, hot,
    layout::{Container, Layout},
    noise::Gauge,
    reduce::{Plan, Reducer, Target},
    rows::{self, Fingerprint, Found},
};
use crate::{camera::Frame, wire::Image};

/// A frame that has been summed to the network's size and has no gain yet.
#[derive(Debug, Default)]
pub struct Linear {
    pub(super) exposed: Exposed,
    pub(super) fingerprint: u64,
}

/// Makes frames linear. After the first frame of a size it takes no memory, if it is given back what it gave.
#[derive(Debug)]
pub struct Linearizer {
    config: Config,
    /// Columns of the next image at most.
    width: usize,
    reducer: Option<(Layout, Reducer)>,
    counts: Vec<u16>,
    gauge: Gauge,
    frame_id: Arc<str>,
    /// Where the next frame is written, so that a frame that turns out to be bad harms no other.
    spare: Linear,
}

impl Linearizer {
    /// One that has seen nothing.
    pub fn new(config: &Config) -> Result<Self, Error> {
        config.check()?;
        Ok(Self {
            config: config.clone(),
            width: config.width_max,
            reducer: None,
            counts: Vec::new(),
            gauge: Gauge::default(),
            frame_id: Arc::default(),
            spare: Linear::default(),
        })
    }

    /// Makes a frame linear. An error spoils this frame only.
    pub fn read(&mut self, frame: &Frame) -> Result<Linear, Error> {
        let image = &frame.image;
        let layout = Layout::read(&self.config, image)?;
        self.gauge.start(&layout, frame.stamp());
        self.reduce(&layout, image)?;
        self.tell_noise(&layout, frame);
        self.name(frame);
        Ok(std::mem::take(&mut self.spare))
    }

    /// Takes back the memory of a frame that is needed no longer; the next one is written there.
    pub fn reuse(&mut self, linear: Linear) {
        self.spare = linear;
    }

    /// Frames become at most so many columns wide from here on, within the settings' bounds.
    pub fn set_width(&mut self, columns: usize) {
        self.width =
            columns.clamp(self.config.width_min.unwrap_or(1).min(self.config.width_max), self.config.width_max);
    }

    /// Reduces the image into the spare frame and holds what it finds against what is declared.
    fn reduce(&mut self, layout: &Layout, image: &Image) -> Result<(), Error> {
        let plan = Plan::new(layout, self.width);
        let mut reducer = match self.reducer.take() {
            Some((_, reducer)) if reducer.plan == plan => reducer,
            _ => Reducer::new(layout, plan),
        };
        let [width, height] = plan.size;
        self.counts.resize(layout.width, 0);
        self.spare.exposed.linear.resize(3 * width * height, 0.0);
        self.spare.exposed.rgb.resize(3 * width * height, 0.0);
        self.spare.exposed.saturated.resize(width * height, 0);
        reducer.start(layout);
        let seen = self.pass(layout, image, &mut reducer);
        let [red, green, blue] = reducer.means();
        self.reducer = Some((*layout, reducer));
        seen.agree(layout, image)?;
        let span = f64::from(layout.white - layout.black);
        // Black levels drift with temperature: a dark frame may lie a little below and is still only dark.
        let mean = (red + 2.0 * green + blue) / 4.0 * span + f64::from(layout.black);
        if mean < f64::from(layout.black) - (span / 256.0).max(1.0) {
            return Err(Error::BlackAboveMean { black: layout.black, mean: mean as f32 });
        }
        let exposed = &mut self.spare.exposed;
        (exposed.width, exposed.height, exposed.scale) = (width, height, plan.scale());
        exposed.raw_mean = ((red + green + blue) / 3.0) as f32;
        let saturated: usize = exposed.saturated.iter().map(|mark| usize::from(*mark)).sum();
        exposed.saturated_part = saturated as f32 / (width * height) as f32;
        self.spare.fingerprint = seen.fingerprint;
        Ok(())
    }

    /// Takes the gauge's reading, and what it means for a pixel of the developed image.
    fn tell_noise(&mut self, layout: &Layout, frame: &Frame) {
        let exposed = &mut self.spare.exposed;
        exposed.noise = self.gauge.finish(layout, frame.stamp());
        let cells = (layout.width / layout.stride() * (layout.height / layout.stride())) as f64;
        // Of a cell's colours, green is the mean of two: the mean variance is 5/6 of one pixel's.
        let pixels = cells / (exposed.width * exposed.height) as f64 * if layout.stride() == 2 { 1.2 } else { 1.0 };
        exposed.noise_level = exposed.noise.map(|noise| noise.level(f64::from(exposed.raw_mean), pixels) as f32);
    }

    /// The one pass over the camera's bytes.
    fn pass(&mut self, layout: &Layout, image: &Image, reducer: &mut Reducer) -> Seen {
        let exposed = &mut self.spare.exposed;
        let mut target = Target { reduced: &mut exposed.linear, saturated: &mut exposed.saturated };
        let mut seen = Seen::default();
        let mut fingerprint = Fingerprint::default();
        let (stride, shift, rows) = (layout.stride(), layout.shift(), reducer.plan.rows());
        for y in 0..layout.height {
            let bytes = layout.row(&image.data, y);
            fingerprint.take(bytes);
            rows::read(layout, bytes, &mut self.counts);
            let mut found = rows::measure(&self.counts, stride);
            seen.raw.join(found);
            if shift > 0 {
                rows::shift_down(&mut self.counts, shift);
                found = Found { max: found.max >> shift, differences: found.differences >> shift, ..found };
            }
            if hot::repair(layout, &image.data, y, &mut self.counts, found, self.config.hot_threshold) {
                found.max = rows::measure(&self.counts, stride).max;
            }
            seen.max = seen.max.max(found.max);
            self.gauge.take(y, &self.counts, stride, layout.white);
            if y < rows {
                reducer.take(y, &self.counts, found.max, &mut target);
            }
        }
        seen.fingerprint = fingerprint.finish();
        seen
    }

    /// Copies the header without taking memory where the name has not changed.
    fn name(&mut self, frame: &Frame) {
        let name = frame.image.header.frame_id.as_str();
        if *self.frame_id != *name {
            self.frame_id = Arc::from(name);
        }
        let exposed = &mut self.spare.exposed;
        (exposed.stamp, exposed.frame_id) = (frame.stamp(), Arc::clone(&self.frame_id));
    }
}

/// What the pass saw of the whole frame.
#[derive(Debug, Default)]
struct Seen {
    /// Of the counts as they came.
    raw: Found,
    /// The largest count, low-justified and with hot pixels repaired.
    max: u16,
    fingerprint: u64,
}

impl Seen {
    /// Refuses a frame whose counts contradict what is declared of them.
    fn agree(&self, layout: &Layout, image: &Image) -> Result<(), Error> {
        let bit_depth = layout.bit_depth;
        let spare = 16 - u32::from(bit_depth);
        if matches!(layout.container, Container::U16Le | Container::U16Be) {
            let below = self.raw.bits & ((1u32 << spare) - 1) as u16;
            if layout.shift() > 0 {
                if below != 0 {
                    return Err(Error::LowBitsSet { bit_depth, spare, seen: below.into() });
                }
            } else if u32::from(self.raw.bits) >> bit_depth != 0 {
                return Err(Error::AboveDepth { bit_depth, limit: (1 << bit_depth) - 1, max: self.raw.max.into() });
            } else {
                low_bits(layout, image, self.raw.bits)?;
            }
        }
        // Pixels differ in where they saturate; an eighth of the range is more than that.
        if f32::from(self.max) > layout.white + (layout.white - layout.black) / 8.0 {
            return Err(Error::AboveWhite { white: layout.white, max: self.max.into() });
        }
        Ok(())
    }
}

/// Non-zero pixels from which the zero bits below them are more than chance.
const PIXELS_MIN: u64 = 1024;

/// Refuses low-justified counts whose low bits are never set while the bits right above them take every combination.
///
/// Fewer zero bits than a high-justified sensor would leave are digital gain, and a picture of few values shows
/// nothing. The counts are only looked through again when the bits of all of them together raise the suspicion.
fn low_bits(layout: &Layout, image: &Image, bits: u16) -> Result<(), Error> {
    let zeros = bits.trailing_zeros();
    let spare = 16 - u32::from(layout.bit_depth);
    if bits == 0 || zeros < spare.max(2) {
        return Ok(());
    }
    let (mut pixels, mut combinations) = (0, 0u16);
    for y in 0..layout.height {
        for x in 0..layout.width {
            let count = layout.count(&image.data, x, y);
            pixels += u64::from(count != 0);
            combinations |= 1 << (count >> zeros & 15);
        }
    }
    if pixels < PIXELS_MIN || combinations != u16::MAX {
        return Ok(());
    }
    // Sensors have an even number of bits, from 8.
    let likely = ((16 - zeros).max(8) + 1) & !1;
    Err(Error::LowBitsZero { bit_depth: layout.bit_depth, zeros, pixels, likely })
}
