//! How far a flow is from the truth: end-point error, outliers as KITTI counts them, and angular error.

use super::flow_files::Field;

/// What a flow is worth on one pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Mean end-point error over the valid pixels, px.
    pub epe: f64,
    /// Part of the valid pixels whose end-point error is above 3 px and above 5 % of the true length (KITTI 2015), 0…1.
    pub fl_all: f64,
    /// Mean angle between (u, v, 1) found and true, degrees (Barron, Fleet and Beauchemin 1994).
    pub aae: f64,
}

/// Scores a flow; `None` where its size is another or no pixel's truth is known. A vector that is not known counts as
/// zero flow, so that nobody gains by silence.
pub fn score(flow: &Field, truth: &Field) -> Option<Score> {
    if (flow.width, flow.height) != (truth.width, truth.height) {
        return None;
    }
    let (mut count, mut error, mut outliers, mut angle) = (0usize, 0.0, 0usize, 0.0);
    for at in (0..truth.vectors.len()).filter(|&at| truth.known(at)) {
        let [u, v] = if flow.known(at) { flow.vectors[at].map(f64::from) } else { [0.0; 2] };
        let [x, y] = truth.vectors[at].map(f64::from);
        let off = (u - x).hypot(v - y);
        count += 1;
        error += off;
        outliers += usize::from(off > 3.0 && off > 0.05 * x.hypot(y));
        // The angle by its tangent: its cosine is of no use for small ones.
        let across = ((v - y).powi(2) + (x - u).powi(2) + (u * y - v * x).powi(2)).sqrt();
        angle += across.atan2(u * x + v * y + 1.0).to_degrees();
    }
    let all = count as f64;
    (count > 0).then(|| Score { epe: error / all, fl_all: outliers as f64 / all, aae: angle / all })
}

/// A mean over pairs and how sure it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Its standard error: deviation over the root of the count; not a number for a single pair.
    pub error: f64,
    /// How many pairs.
    pub count: usize,
}

impl Spread {
    /// Of these values; `None` of none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let count = values.len();
        if count == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / count as f64;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let error = (squares / (count as f64 - 1.0) / count as f64).sqrt();
        Some(Self { mean, error, count })
    }
}
