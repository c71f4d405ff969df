//! What real sensors do beside the white noise that networks are trained with: rows, bands, patterns that stay, long tails,
//! few bits, and previews.
//!
//! Each kind comes on top of the camera's own noise at a rung of the [`ladder`](super::ladder), whose draws stay the
//! very same, so that what moves between two kinds is the fault and not the luck of a draw. Only `tukey` changes how
//! noise is drawn: its read noise takes the place of the Gaussian one, and the photons stay.
//!
//! Rows, bands and fixed pattern are told in parts of that noise: their deviation is [`STRENGTH`] × √(a·y + b) of the
//! green photosites at the rung's mean y, which the scaling brings to 0.4. Good cameras are better: in the four that Wei
//! et al. (see [`LAMBDA`]) measured, rows deviate by a twentieth to a sixth of the read noise. Half of *all* noise is a bad
//! sensor or a bad supply, and as bad at each exposure. It raises the variance by a quarter, which as white noise would
//! be an eighth more of noise level, far less than the step between two exposures: what a method loses beyond that, it
//! loses to the structure.
//!
//! A fault of the sensor comes before the raw is quantised and clipped, at its black level; `jpeg8` comes after the
//! scaling, since it is what is shown that is compressed. Every colour of a pixel is offset by the same, as by one row's
//! or column's amplifier; only the pixels' own part of `fixed` differs by colour, as photosites do.
//!
//! What is drawn for a pair is drawn once, and only its height follows the noise of an exposure: the same camera and the
//! same drift in ever less light. It is drawn by plain arithmetic, the same bits on every machine and number of threads;
//! the camera's noise is as good as the ladder's, and the preview as the decoder of the `image` crate.

use xxhash_rust::xxh3::xxh3_64_with_seed;

use super::{
    curves::{power, sine},
    gaussians::Gaussians,
    noise::{Noise, Normals},
    picture::{self, Picture},
};

/// Deviation of rows, bands and fixed pattern, in parts of the camera's own noise at the rung's mean.
pub const STRENGTH: f64 = 0.5;

/// Rows after which a band comes again: the side of the coarsest cell in which the networks match. It is too wide to
/// be averaged away within a patch, and narrow enough to be there several times. Mains flicker under a rolling shutter
/// comes to some hundred rows, a switching supply to a few.
pub const BAND: f64 = 64.0;

/// Shape of the read noise of `tukey`; 0.14 is all but normal, 0 logistic, −1 all but Cauchy. Of the 66 values that were
/// measured for "A Physics-Based Noise Formation Model for Extreme Low-Light Raw Denoising" (Wei, Fu, Yang and Huang, CVPR
/// 2020) on four cameras and published with its code, −0.24 to 0.14, half are below −0.086; of those at the higher
/// gains, half are below −0.13.
pub const LAMBDA: f64 = -0.1;

/// The deviation of a Tukey-lambda distribution of [`LAMBDA`] with scale 1: √(2/λ²·(1/(1 + 2λ) − Γ(1 + λ)²/Γ(2 + 2λ))).
const LAMBDA_DEVIATION: f64 = 2.186_435_949_2;

/// Counts of a 14-bit raw that a step of a 10-bit one is wide.
const TEN_BITS: f64 = 16.0;

/// The greatest count that ten bits can tell.
const TEN_BITS_MOST: f64 = 1023.0;

/// Quality of the preview, of 100. Cameras' previews are about as good; the encoder keeps both chromas at full
/// resolution.
pub const QUALITY: u8 = 80;

/// A kind of noise that networks were not trained with, as it is named on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(into = "&'static str")]
pub enum Fault {
    /// Nothing but the camera's own, white noise.
    None,
    /// Each row of each frame has a normal offset of its own.
    Rows,
    /// A sine over the rows that comes again after [`BAND`]; where it starts, and how far it drifts from one frame to the
    /// next, is drawn for each pair.
    Banding,
    /// Each column and each photosite has a normal offset, half of the variance each, the same in both frames: what
    /// says that nothing moves. Each pair has a camera of its own.
    Fixed,
    /// Read noise of long tails, with the variance of the camera's.
    Tukey,
    /// Ten bits instead of fourteen.
    TenBit,
    /// An 8-bit JPEG of the scaled frame, in linear light as all methods see it: a camera's tone curve is no noise.
    Jpeg,
}

/// Every kind by its name, with what a report says of it.
pub const FAULTS: [(&str, Fault, &str); 7] = [
    ("none", Fault::None, "the camera's noise alone"),
    ("rows", Fault::Rows, "each row of each frame is offset, half of the noise's deviation"),
    ("banding", Fault::Banding, "a sine of 64 rows that drifts between frames, half of the noise's deviation"),
    ("fixed", Fault::Fixed, "columns and pixels offset alike in both frames, half of the noise's deviation"),
    ("tukey", Fault::Tukey, "Tukey-lambda read noise, λ = −0.1, of the same variance"),
    ("10bit", Fault::TenBit, "the raw has 10 bits instead of 14"),
    ("jpeg8", Fault::Jpeg, "8-bit JPEG of quality 80 of the scaled frames"),
];

/// A name that names no kind of noise.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{given:?} is no kind of noise; expected {}", FAULTS.map(|(name, ..)| name).join(", "))]
pub struct Unknown {
    given: String,
}

impl std::str::FromStr for Fault {
    type Err = Unknown;

    fn from_str(text: &str) -> Result<Self, Unknown> {
        let found = FAULTS.into_iter().find(|(name, ..)| *name == text);
        found.map(|(_, fault, _)| fault).ok_or_else(|| Unknown { given: text.into() })
    }
}

impl From<Fault> for &'static str {
    fn from(fault: Fault) -> Self {
        FAULTS[fault as usize].0
    }
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad((*self).into())
    }
}

impl Fault {
    /// What a report says of it.
    pub fn about(self) -> &'static str {
        FAULTS[self as usize].2
    }

    /// The camera's noise as far as it is still drawn as ever.
    pub(super) fn kept(self, noise: &Noise) -> Noise {
        if self == Self::Tukey { Noise { b: [0.0; 3], ..*noise } } else { *noise }
    }

    /// Counts of a 14-bit raw between two values that can be told apart.
    pub(super) fn step(self) -> f64 {
        if self == Self::TenBit { TEN_BITS } else { 1.0 }
    }

    /// The count of a 14-bit raw that a signal of so many counts becomes.
    pub(super) fn quantised(self, counts: f64, white: f64) -> u16 {
        match self {
            Self::TenBit => (TEN_BITS * (counts / TEN_BITS).round().clamp(0.0, TEN_BITS_MOST)) as u16,
            _ => counts.round().clamp(0.0, white) as u16,
        }
    }

    /// What a method is shown of a scaled frame.
    pub fn shown(self, frame: Picture) -> Result<Picture, picture::Unpacked> {
        if self == Self::Jpeg { frame.through_jpeg(QUALITY) } else { Ok(frame) }
    }

    /// Everything that is added to one frame of a pair, whose own noise deviates by `white` at its mean and is `noise`.
    pub(super) fn pattern(
        self,
        [width, height]: [usize; 2],
        frame: usize,
        white: f64,
        noise: &Noise,
        seed: u64,
    ) -> Pattern {
        let seed = xxh3_64_with_seed(<&str>::from(self).as_bytes(), seed);
        let deviation = STRENGTH * white;
        let normal = |part: u64, count: usize, deviation: f64| {
            let mut draws = vec![0.0f32; count];
            Gaussians::new(seed, [part, 0]).fill(&mut draws);
            draws.into_iter().map(|draw| deviation * f64::from(draw)).collect::<Vec<f64>>()
        };
        let none = Pattern { rows: vec![], columns: vec![], pixels: vec![], tails: None };
        match self {
            Self::None | Self::TenBit | Self::Jpeg => none,
            Self::Rows => Pattern { rows: normal(frame as u64, height, deviation), ..none },
            Self::Banding => {
                let mut draws = Normals::new(seed, 0);
                let (start, drift) = (draws.uniform(), draws.uniform());
                let turn = |row: usize| row as f64 / BAND + start + drift * frame as f64;
                let height_of_sine = std::f64::consts::SQRT_2 * deviation;
                Pattern { rows: (0..height).map(|row| height_of_sine * sine(turn(row))).collect(), ..none }
            }
            // Not a word of the frame: it is the same in both.
            Self::Fixed => {
                let half = deviation * std::f64::consts::FRAC_1_SQRT_2;
                Pattern { columns: normal(0, width, half), pixels: normal(1, 3 * width * height, half), ..none }
            }
            Self::Tukey => {
                let scale = noise.b.map(|b| b.max(0.0).sqrt() / LAMBDA_DEVIATION);
                Pattern { tails: Some(Tails { scale, seed, frame }), ..none }
            }
        }
    }
}

/// What is added to a frame's raw values of 0…1; what is empty adds nothing.
pub(super) struct Pattern {
    rows: Vec<f64>,
    columns: Vec<f64>,
    /// `height` × `width` × 3.
    pixels: Vec<f64>,
    tails: Option<Tails>,
}

/// Read noise of long tails.
struct Tails {
    /// By colour, 0…1.
    scale: [f64; 3],
    seed: u64,
    frame: usize,
}

impl Pattern {
    /// What is added to the values of one row, one after the other.
    pub(super) fn row(&self, row: usize, width: usize) -> impl Iterator<Item = f64> {
        let offset = self.rows.get(row).copied().unwrap_or(0.0);
        let mut tails = self.tails.as_ref().map(|tails| (Normals::of_row(tails.seed, tails.frame, row), tails.scale));
        (0..3 * width).map(move |at| {
            let column = self.columns.get(at / 3).copied().unwrap_or(0.0);
            let pixel = self.pixels.get(row * 3 * width + at).copied().unwrap_or(0.0);
            let tail = tails.as_mut().map_or(0.0, |(draws, scale)| scale[at % 3] * tukey(draws.uniform()));
            offset + column + pixel + tail
        })
    }
}

/// The value below which this part of a Tukey-lambda distribution of [`LAMBDA`] and scale 1 lies.
fn tukey(part: f64) -> f64 {
    // Neither end, where it has no value.
    let part = part.clamp(f64::EPSILON / 2.0, 1.0 - f64::EPSILON / 2.0);
    let tail = |part: f64| 1.0 / power(part, -LAMBDA);
    (tail(part) - tail(1.0 - part)) / LAMBDA
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stand_where_their_kinds_do() {
        for (at, (name, fault, about)) in FAULTS.into_iter().enumerate() {
            assert_eq!((fault as usize, fault.to_string(), fault.about()), (at, name.to_owned(), about));
        }
        assert!(Fault::Banding.about().contains(&format!("{BAND} rows")) && STRENGTH == 0.5);
        assert!(Fault::Jpeg.about().contains(&format!("quality {QUALITY} ")) && LAMBDA == -0.1);
    }

    #[test]
    fn what_is_drawn_is_the_same_on_every_machine() {
        let noise = Noise { a: [0.0; 3], b: [1e-6, 2e-6, 3e-6] };
        let bits = |fault: Fault, frame: usize| {
            let pattern = fault.pattern([40, 70], frame, 1e-3, &noise, 5);
            let bytes: Vec<u8> = (0..70).flat_map(|row| pattern.row(row, 40)).flat_map(f64::to_le_bytes).collect();
            xxh3_64_with_seed(&bytes, 0)
        };
        let found =
            [Fault::Rows, Fault::Banding, Fault::Fixed, Fault::Tukey].map(|fault| [0, 1].map(|i| bits(fault, i)));
        let known = [
            [0x012cd141d6190ea7, 0xa0c1f983c1276a2b],
            [0x333843473e59c59d, 0x751c70ee7c121e1a],
            [0x9d1490ea6e980d11, 0x9d1490ea6e980d11],
            [0x5732a38c58a8e1e6, 0x9ec94294bcf22d71],
        ];
        assert_eq!(found, known, "{found:#x?}");
    }

    #[test]
    fn the_distribution_is_tukeys() {
        assert_eq!(tukey(0.5), 0.0);
        // (0.9^λ − 0.1^λ)/λ.
        assert!((tukey(0.9) - (0.9f64.powf(-0.1) - 0.1f64.powf(-0.1)) / -0.1).abs() < 1e-12);
        assert!((tukey(0.9) + tukey(0.1)).abs() < 1e-12);
        assert!(tukey(0.0).is_finite() && tukey(1.0 - f64::EPSILON / 2.0) > 100.0);
        // Its variance, by the sum over a million parts; the tails beyond hold a few thousandths.
        let parts = 1_000_000;
        let variance = (0..parts).map(|i| tukey((f64::from(i) + 0.5) / f64::from(parts)).powi(2)).sum::<f64>();
        let deviation = (variance / f64::from(parts)).sqrt();
        assert!((deviation / LAMBDA_DEVIATION - 1.0).abs() < 1e-3, "{deviation}");
    }
}
