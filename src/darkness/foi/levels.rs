//! Level sets: parts of like brightness, smooth enough that their detail is noise alone.

use super::wavelet::{self, Wavelet};

/// A set's mean and the noise's deviation in it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Level {
    /// Mean of the values as they came, that is, clipped.
    pub mean: f64,
    /// Deviation of the noise around it, clipped as well.
    pub deviation: f64,
    /// Coefficients that it was measured on.
    pub count: usize,
}

/// Half the side of the window that brightness and texture are looked at in, coefficients.
const REACH: usize = 3;
/// Sets, where there are coefficients enough for so many.
const SETS_MAX: usize = 64;
/// Coefficients of a set before texture is sorted out, at least.
const SET_MIN: usize = 256;
/// Fewer sets than this can't carry a line.
pub(super) const SETS_MIN: usize = 6;
/// The part of a set that is kept, the smoothest.
const SMOOTH: f64 = 0.2;
/// Median of |x| of a normal x of deviation 1.
const MEDIAN: f64 = 0.674_489_750_196;
/// By how much the median of n such |x| is too large on average, times n (simulated, 11 ≤ n ≤ 200).
const MEDIAN_BIAS: f64 = 0.27;
/// Variance of a deviation found by the median of n coefficients, times n over σ²: the price of robustness.
pub(super) const MEDIAN_SPREAD: f64 = 1.36;

/// A coefficient and its surroundings.
#[derive(Debug, Clone, Copy)]
struct Cell {
    /// Brightness by the even coefficients of the window: which set it belongs to.
    sorted_by: f32,
    /// Brightness by the odd ones. Noise that lifted a cell into a brighter set has no part in it, so that the set's
    /// mean is not drawn towards its neighbours.
    mean: f32,
    /// Sum of the squared steps between the window's local means.
    texture: f32,
    detail: f32,
}

/// Coefficients that a plane of this size would give.
pub(super) fn cells(width: usize, height: usize) -> usize {
    let inner = |side| wavelet::coefficients(side).saturating_sub(2 * REACH);
    inner(width) * inner(height)
}

/// How many cells there must be.
pub(super) const CELLS_MIN: usize = SETS_MIN * SET_MIN;

/// The level sets of a plane, darkest first.
///
/// The edge detection of the paper compares gradients with the local noise. Here each set keeps that part of it whose
/// surroundings vary least: within a set the noise is the same everywhere, so what varies more has texture, and no
/// threshold has to know the noise before it is measured. The local means are independent of the detail, so the choice
/// leaves the noise in the detail as it was.
pub(super) fn levels(plane: &[f32], width: usize, height: usize) -> Vec<Level> {
    let mut cells = surroundings(&wavelet::split(plane, width, height));
    cells.sort_by(|a, b| a.sorted_by.total_cmp(&b.sorted_by));
    let size = (cells.len() / SETS_MAX).max(SET_MIN);
    let sets = cells.len() / size;
    // The remainder joins the last set.
    (0..sets)
        .map(|set| {
            let end = if set + 1 == sets { cells.len() } else { (set + 1) * size };
            measure(&mut cells[set * size..end].to_vec())
        })
        .collect()
}

fn measure(set: &mut [Cell]) -> Level {
    set.sort_by(|a, b| a.texture.total_cmp(&b.texture));
    let count = (set.len() as f64 * SMOOTH) as usize;
    let kept = &set[..count];
    let mean = kept.iter().map(|cell| f64::from(cell.mean)).sum::<f64>() / count as f64;
    let mut sizes: Vec<f32> = kept.iter().map(|cell| cell.detail.abs()).collect();
    sizes.sort_by(f32::total_cmp);
    let median = 0.5 * (f64::from(sizes[(count - 1) / 2]) + f64::from(sizes[count / 2]));
    Level { mean, deviation: median / MEDIAN / (1.0 + MEDIAN_BIAS / count as f64), count }
}

fn surroundings(wavelet: &Wavelet) -> Vec<Cell> {
    let Wavelet { width, height, approximation, detail } = wavelet;
    let (width, height) = (*width, *height);
    let steps: Vec<f32> = (0..width * height)
        .map(|at| {
            let here = approximation[at];
            let right = if at % width + 1 < width { approximation[at + 1] - here } else { 0.0 };
            let below = if at + width < width * height { approximation[at + width] - here } else { 0.0 };
            right * right + below * below
        })
        .collect();
    let side = 2 * REACH + 1;
    let mut cells = Vec::with_capacity(width * height);
    for y in REACH..height - REACH {
        for x in REACH..width - REACH {
            let mut sums = [0.0_f32; 2];
            let mut texture = 0.0;
            for row in y - REACH..=y + REACH {
                let from = row * width + x - REACH;
                let here = &approximation[from..from + side];
                for (k, value) in here.iter().enumerate() {
                    sums[(row + y + k) % 2] += value;
                }
                texture += steps[from..from + side].iter().sum::<f32>();
            }
            // Of 49 cells 25 have one parity and 24 the other.
            let odd = (y - REACH + y) % 2;
            let counts = if odd == 0 { [25.0, 24.0] } else { [24.0, 25.0] };
            let [even, odd] = [sums[0] / counts[0], sums[1] / counts[1]];
            cells.push(Cell { sorted_by: even, mean: odd, texture, detail: detail[y * width + x] });
        }
    }
    cells
}
