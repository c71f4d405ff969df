//! The brightness ladder: a clean pair with known flow, photographed ever darker, then scaled as the paper scales raws.
//!
//! 1. *Linearise*: the inverse of the sRGB curve (IEC 61966-2-1), since shot noise is a law of linear light.
//! 2. *Expose*: one factor for both frames brings their mean to a rung of [`MEANS`], in parts of the white level; what
//!    is above white saturates.
//! 3. *Noise*: photons are counted (Poisson, a is one electron's part of white) and read (Gaussian of variance b), with
//!    the measured a and b of a camera ([`profiles`]), fresh in every pixel, colour and frame.
//! 4. *Quantise*: to whole 14-bit counts above the camera's black level. The level leaves room for noise below black,
//!    which is kept: cutting it off would lift dark means.
//! 5. *Scale*: black off, divided by white minus black, and one linear gain, the same for both frames, that brings their
//!    mean to [`SCALED`]; then clipped to 0…1.
//!
//! Where VBOF's procedure demosaics, three full colours are noised here, as for the published reference figures: a
//! mosaic would add the demosaicing's errors to the flow's.
//!
//! After the scaling a gain r has made of the noise a' = r·a and b' = r²·b on values around 0.4.
//!
//! A camera may have a fault besides ([`faults`](super::faults)): it comes between steps 3 and 4.

use rayon::prelude::*;
use xxhash_rust::xxh3::xxh3_64_with_seed;

use super::{
    faults::{Fault, Pattern},
    noise::{Noise, Normals},
    picture::Picture,
    profiles,
    raws::BLACKS,
};

/// Raw means of Exp-0 … Exp-6, in parts of the white level.
pub const MEANS: [f64; 7] = [0.4, 0.1, 0.03, 0.01, 0.004, 0.002, 0.001];

/// The mean that both frames are scaled to.
pub const SCALED: f64 = 0.4;

/// White level of a 14-bit raw.
const WHITE: f64 = 16383.0;

/// Black level of makers that are not in [`BLACKS`].
const BLACK_OF_OTHERS: f64 = 512.0;

/// A camera that can photograph a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    /// Its noise on raw values of 0 (black) to 1 (white).
    pub noise: Noise,
    /// Counts without light.
    pub black: f64,
    /// Counts of a full pixel.
    pub white: f64,
    /// What it does to pictures besides.
    pub fault: Fault,
}

impl Sensor {
    /// The camera of this name at this ISO, as measured.
    pub fn find(camera: &str, iso: u32) -> Result<Self, profiles::Error> {
        let noise = profiles::find(camera, iso)?;
        let name = camera.trim().to_lowercase();
        let maker = BLACKS.iter().find(|(maker, _)| name.starts_with(maker));
        let black = maker.map_or(BLACK_OF_OTHERS, |(_, black)| *black);
        Ok(Self { noise, black, white: WHITE, fault: Fault::None })
    }
}

/// A pair in linear light, 1 = the brightest that its file can say.
#[derive(Debug, Clone)]
pub struct Linear {
    width: usize,
    height: usize,
    /// `height` × `width` × 3 each.
    frames: [Vec<f32>; 2],
    mean: f64,
}

/// The light that an sRGB byte stands for, 0…1.
pub fn light(byte: u8) -> f64 {
    let value = f64::from(byte) / 255.0;
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

impl Linear {
    /// Linearises both frames, which are of one size.
    pub fn of(frames: [&Picture; 2]) -> Self {
        let table: Vec<f32> = (0..=255).map(|byte| light(byte) as f32).collect();
        let linear = frames.map(|frame| frame.rgb.iter().map(|byte| table[usize::from(*byte)]).collect::<Vec<f32>>());
        let sum: f64 = linear.iter().flatten().map(|value| f64::from(*value)).sum();
        let count = linear.iter().map(Vec::len).sum::<usize>().max(1);
        Self { width: frames[0].width, height: frames[0].height, mean: sum / count as f64, frames: linear }
    }

    /// The pair in linear light without noise, both frames scaled to the mean [`SCALED`] by one gain and clipped.
    pub fn scaled(&self) -> [Picture; 2] {
        let gain = (SCALED / self.mean.max(1e-6)) as f32;
        self.frames.each_ref().map(|frame| {
            let values: Vec<f32> = frame.iter().map(|light| light * gain).collect();
            Picture::from_unit(self.width, self.height, &values)
        })
    }

    /// Photographs the pair at this raw mean. The same `seed`, `name`, mean and sensor give the same bits, whatever the
    /// number of threads; another name draws other noise.
    pub fn expose(&self, sensor: &Sensor, raw_mean: f64, seed: u64, name: &str) -> Rung {
        let factor = raw_mean / self.mean.max(f64::MIN_POSITIVE);
        // Of every exposure the same: two of them differ by their light.
        let fault_seed = xxh3_64_with_seed(name.as_bytes(), seed);
        let seed = xxh3_64_with_seed(name.as_bytes(), seed ^ raw_mean.to_bits());
        let white = sensor.noise.variance(1, raw_mean).sqrt();
        let counts = [0, 1].map(|frame| {
            let pattern = sensor.fault.pattern([self.width, self.height], frame, white, &sensor.noise, fault_seed);
            self.photograph(frame, factor, sensor, &pattern, seed)
        });
        let span = sensor.white - sensor.black;
        let sum: f64 = counts.iter().flatten().map(|count| f64::from(*count) - sensor.black).sum();
        let measured = sum / span / counts.iter().map(Vec::len).sum::<usize>().max(1) as f64;
        let gain = SCALED / measured.max(0.5 / span);
        let scale = |count: &u16| ((f64::from(*count) - sensor.black) / span * gain).clamp(0.0, 1.0) as f32;
        let clean = self.frames[0].iter().map(|&light| ((f64::from(light) * factor).min(1.0) * gain) as f32).collect();
        Rung {
            width: self.width,
            height: self.height,
            scaled: counts.map(|counts| counts.iter().map(scale).collect()),
            clean,
            gain,
            noise: Noise { a: sensor.noise.a.map(|a| a * gain), b: sensor.noise.b.map(|b| b * gain * gain) },
            step: sensor.fault.step() * gain / span,
        }
    }

    fn photograph(&self, frame: usize, factor: f64, sensor: &Sensor, pattern: &Pattern, seed: u64) -> Vec<u16> {
        let mut counts = vec![0; self.frames[frame].len()];
        let (span, noise) = (sensor.white - sensor.black, sensor.fault.kept(&sensor.noise));
        let rows = counts.par_chunks_exact_mut(3 * self.width).zip(self.frames[frame].par_chunks_exact(3 * self.width));
        rows.enumerate().for_each(|(row, (counts, lights))| {
            let mut draws = Normals::of_row(seed, frame, row);
            let added = pattern.row(row, self.width);
            for (at, ((count, light), added)) in counts.iter_mut().zip(lights).zip(added).enumerate() {
                let clean = (f64::from(*light) * factor).min(1.0);
                let raw = noise.counted(at % 3, clean, &mut draws) + added;
                *count = sensor.fault.quantised(sensor.black + span * raw, sensor.white);
            }
        });
        counts
    }
}

/// One rung of the ladder: a pair as it comes out of the dark.
#[derive(Debug, Clone)]
pub struct Rung {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Both frames, scaled and clipped: `height` × `width` × 3, 0…1.
    pub scaled: [Vec<f32>; 2],
    /// The older frame without noise, scaled by the same gain and not clipped.
    pub clean: Vec<f32>,
    /// The gain of the scaling, r.
    pub gain: f64,
    /// The noise after the scaling, r·a and r²·b, without what a fault adds.
    pub noise: Noise,
    /// One raw count after the scaling; quantisation adds a twelfth of its square to the variance.
    pub step: f64,
}

impl Rung {
    /// Both frames in 8 bits, as methods see them.
    pub fn pictures(&self) -> [Picture; 2] {
        self.scaled.each_ref().map(|values| Picture::from_unit(self.width, self.height, values))
    }

    /// Variance of a scaled value whose clean value is this: noise, 14-bit and 8-bit quantisation.
    pub fn variance(&self, colour: usize, clean: f64) -> f64 {
        self.noise.variance(colour, clean) + (self.step * self.step + 1.0 / (255.0 * 255.0)) / 12.0
    }
}
