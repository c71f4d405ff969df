//! What can be done to a dark frame before a method sees it: nothing, non-local means, a blur, a median.

use rayon::prelude::*;

use super::{nlm, picture::Picture};

/// An enhancement of single frames, as it is named on the command line.
#[derive(Debug, Clone, PartialEq)]
pub enum Enhancer {
    /// The frame as it is.
    None,
    /// Non-local means with OpenCV's meaning and the paper's parameters (h 10, hColor 10, template 7, search 21).
    Nlm,
    /// A Gaussian blur of this deviation in pixels.
    Gaussian(f64),
    /// The median of a square of this odd side, in each colour.
    Median(usize),
    /// A user's network: NCHW, RGB, 0…1, to the same.
    Onnx(std::path::PathBuf),
}

/// A name that names no enhancement.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no enhancer; expected none, nlm, gaussian (or gaussian:SIGMA, 0.1 … 20), median (or median:SIDE, odd, \
     3 … 15) or onnx:FILE"
)]
pub struct Unknown(String);

impl std::str::FromStr for Enhancer {
    type Err = Unknown;

    fn from_str(text: &str) -> Result<Self, Unknown> {
        let unknown = || Unknown(text.into());
        let (name, value) = text.split_once(':').map_or((text, None), |(name, value)| (name, Some(value)));
        match (name, value) {
            ("none", None) => Ok(Self::None),
            ("nlm", None) => Ok(Self::Nlm),
            ("gaussian", value) => {
                let sigma = value.map_or(Ok(2.0), str::parse).map_err(|_| unknown())?;
                if (0.1..=20.0).contains(&sigma) { Ok(Self::Gaussian(sigma)) } else { Err(unknown()) }
            }
            ("median", value) => {
                let side = value.map_or(Ok(5), str::parse).map_err(|_| unknown())?;
                if side % 2 == 1 && (3..=15).contains(&side) { Ok(Self::Median(side)) } else { Err(unknown()) }
            }
            ("onnx", Some(file)) if !file.is_empty() => Ok(Self::Onnx(file.into())),
            _ => Err(unknown()),
        }
    }
}

impl std::fmt::Display for Enhancer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::None => f.write_str("none"),
            Self::Nlm => f.write_str("nlm"),
            Self::Gaussian(sigma) => write!(f, "gaussian:{sigma}"),
            Self::Median(side) => write!(f, "median:{side}"),
            Self::Onnx(file) => write!(f, "{}", file.file_stem().unwrap_or_default().to_string_lossy()),
        }
    }
}

/// The enhanced frame; `None` for a network, which is not this file's to run.
pub fn enhance(by: &Enhancer, frame: &Picture) -> Option<Picture> {
    match by {
        Enhancer::None => Some(frame.clone()),
        Enhancer::Nlm => Some(nlm::coloured(frame, &nlm::Settings::default())),
        Enhancer::Gaussian(sigma) => Some(gaussian(frame, *sigma)),
        Enhancer::Median(side) => Some(median(frame, *side)),
        Enhancer::Onnx(_) => None,
    }
}

/// Where index `i`, which may lie outside, reads in a line that is reflected at its ends: 2 1 0 1 2 … (no edge twice).
pub(super) fn mirrored(i: isize, length: usize) -> usize {
    crate::flow::padding::reflected(i.unsigned_abs(), length)
}

/// A separable blur of a kernel that reaches three deviations, the picture reflected at its edges.
fn gaussian(frame: &Picture, sigma: f64) -> Picture {
    let reach = (3.0 * sigma).ceil() as isize;
    let kernel: Vec<f32> = (-reach..=reach).map(|i| (-0.5 * (i as f64 / sigma).powi(2)).exp() as f32).collect();
    let sum: f32 = kernel.iter().sum();
    let kernel: Vec<f32> = kernel.iter().map(|weight| weight / sum).collect();
    let (width, height) = (frame.width, frame.height);
    let mut across = vec![0.0f32; frame.rgb.len()];
    across.par_chunks_exact_mut(3 * width).zip(frame.rgb.par_chunks_exact(3 * width)).for_each(|(into, from)| {
        for x in 0..width {
            for (weight, i) in kernel.iter().zip(-reach..) {
                let place = 3 * mirrored(x as isize + i, width);
                for c in 0..3 {
                    into[3 * x + c] += weight * f32::from(from[place + c]);
                }
            }
        }
    });
    let mut rgb = vec![0u8; frame.rgb.len()];
    rgb.par_chunks_exact_mut(3 * width).enumerate().for_each(|(y, into)| {
        let mut line = vec![0.0f32; 3 * width];
        for (weight, i) in kernel.iter().zip(-reach..) {
            let from = &across[mirrored(y as isize + i, height) * 3 * width..][..3 * width];
            line.iter_mut().zip(from).for_each(|(sum, value)| *sum += weight * value);
        }
        into.iter_mut().zip(&line).for_each(|(byte, value)| *byte = value.round().clamp(0.0, 255.0) as u8);
    });
    Picture { width, height, rgb }
}

/// The median of each colour in a square; beyond the edge its last pixel goes on, as in OpenCV's `medianBlur`.
fn median(frame: &Picture, side: usize) -> Picture {
    let (width, height, half) = (frame.width, frame.height, (side / 2) as isize);
    let clamp = |at: isize, length: usize| at.clamp(0, length as isize - 1) as usize;
    let mut rgb = vec![0u8; frame.rgb.len()];
    rgb.par_chunks_exact_mut(3 * width).enumerate().for_each(|(y, into)| {
        let mut square = Vec::with_capacity(side * side);
        for (at, byte) in into.iter_mut().enumerate() {
            let (x, c) = (at / 3, at % 3);
            square.clear();
            for dy in -half..=half {
                let row = &frame.rgb[clamp(y as isize + dy, height) * 3 * width..][..3 * width];
                square.extend((-half..=half).map(|dx| row[3 * clamp(x as isize + dx, width) + c]));
            }
            let middle = square.len() / 2;
            *byte = *square.select_nth_unstable(middle).1;
        }
    });
    Picture { width, height, rgb }
}
