//! How well each cell's own texture shows a displacement, the noise's share of its gradients taken off.

use crate::exposure::Exposed;

/// Developed pixels a side of one bin of grey: it halves the noise, and a network sees little that is finer.
const BIN: usize = 2;
/// Bins beyond each side of the cell that count for it, as a part of the cell's own width.
const MARGIN: f32 = 1.0;

/// A cell whose own texture is for certain below this part of what lies around it shows its neighbours' motion.
const OWN_MIN: f64 = 0.2;

/// Information about a displacement: xx, xy, yy of Σ∇I∇Iᵀ over twice the variance, 1 / (developed pixel)².
pub(super) type Information = [f64; 3];

/// The gradients of one frame, and its scratch memory.
#[derive(Debug, Default)]
pub(super) struct Texture {
    columns: usize,
    rows: usize,
    grey: Vec<f32>,
    variance: Vec<f32>,
    blocked: Vec<bool>,
    /// Integral images of Gxx, Gxy, Gyy, of what noise alone would make of Gxx and Gyy, of the variance, of the pixels
    /// that count; (columns + 1) × (rows + 1).
    sums: Vec<[f64; 6]>,
    scale: [f32; 2],
}

impl Texture {
    /// Looks at a developed frame. Without a known noise the texture is told from none at all: it then says nothing.
    pub(super) fn look(&mut self, image: &Exposed) {
        (self.columns, self.rows) = (image.width / BIN, image.height / BIN);
        self.scale = image.scale.map(|scale| scale * BIN as f32);
        self.fill(image);
        let width = self.columns + 1;
        self.sums.clear();
        self.sums.resize(width * (self.rows + 1), [0.0; 6]);
        for row in 0..self.rows {
            let mut line = [0.0; 6];
            for column in 0..self.columns {
                if let Some(found) = self.gradient(column, row) {
                    for (sum, one) in line.iter_mut().zip(found) {
                        *sum += one;
                    }
                }
                let above = self.sums[row * width + column + 1];
                self.sums[(row + 1) * width + column + 1] = std::array::from_fn(|i| above[i] + line[i]);
            }
        }
    }

    /// Bins of grey, what noise each has, and whether it holds a saturated pixel.
    fn fill(&mut self, image: &Exposed) {
        let plane = image.width * image.height;
        let gain = f64::from(image.gain);
        let mean = f64::from(image.raw_mean);
        // The level is that of an averaged pixel once its mean is 0.4.
        let per_raw = match (&image.noise, image.noise_level) {
            (Some(noise), Some(level)) if noise.variance(mean) > 0.0 => {
                (f64::from(level) / 255.0 * gain * mean / 0.4).powi(2) / noise.variance(mean)
            }
            _ => 0.0,
        };
        let bins = (BIN * BIN) as f32;
        self.grey.clear();
        self.variance.clear();
        self.blocked.clear();
        for row in 0..self.rows {
            for column in 0..self.columns {
                let (mut sum, mut blocked) = (0.0, false);
                for (y, x) in (0..BIN).flat_map(|y| (0..BIN).map(move |x| (y, x))) {
                    let at = (row * BIN + y) * image.width + column * BIN + x;
                    sum += (0..3).map(|c| image.rgb.get(c * plane + at).copied().unwrap_or(0.0)).sum::<f32>();
                    blocked |= image.saturated.get(at).is_some_and(|s| *s > 0);
                }
                let grey = sum / (3.0 * bins);
                let variance = image.noise.map_or(0.0, |n| per_raw * n.variance(f64::from(grey) / gain.max(1e-9)));
                self.grey.push(grey);
                self.variance.push((variance / f64::from(3.0 * bins)) as f32);
                self.blocked.push(blocked);
            }
        }
    }

    /// Central differences of a bin: Gxx, Gxy, Gyy, the noise's share of Gxx, the variance, 1.
    fn gradient(&self, column: usize, row: usize) -> Option<[f64; 6]> {
        if column == 0 || row == 0 || column + 1 >= self.columns || row + 1 >= self.rows {
            return None;
        }
        let at = row * self.columns + column;
        let near = [at - 1, at + 1, at - self.columns, at + self.columns];
        if near.iter().any(|i| self.blocked[*i]) {
            return None;
        }
        let [left, right, up, down] = near.map(|i| f64::from(self.grey[i]));
        let (gx, gy) = (0.5 * (right - left), 0.5 * (down - up));
        let noise: f64 = near.iter().map(|i| f64::from(self.variance[*i])).sum();
        // Each difference has a quarter of two bins' variances; both together, half of the mean of four.
        Some([gx * gx, gx * gy, gy * gy, 0.125 * noise, f64::from(self.variance[at]), 1.0])
    }

    /// Sums over the bins within `half` camera pixels of `centre`.
    fn window(&self, centre: [f32; 2], half: [f32; 2]) -> [f64; 6] {
        let width = self.columns + 1;
        let side = |i: usize, most: usize| {
            let bin = |pixel: f32| ((pixel + 0.5) / self.scale[i]).round().clamp(0.0, most as f32) as usize;
            [bin(centre[i] - half[i]), bin(centre[i] + half[i])]
        };
        let ([left, right], [top, bottom]) = (side(0, self.columns), side(1, self.rows));
        let corner = |column: usize, row: usize, i: usize| self.sums.get(row * width + column).map_or(0.0, |s| s[i]);
        let sum = |i| corner(right, bottom, i) - corner(left, bottom, i) - corner(right, top, i) + corner(left, top, i);
        std::array::from_fn(sum)
    }

    /// What a cell at camera pixel `centre`, `size` camera pixels wide and high, knows of its displacement.
    pub(super) fn at(&self, centre: [f32; 2], size: [f32; 2]) -> Information {
        let [xx, xy, yy, noise, variance, count] = self.window(centre, size.map(|side| (0.5 + MARGIN) * side));
        let own = self.window(centre, size.map(|side| 0.5 * side));
        if count < 1.0 || own[5] < 1.0 {
            return [0.0; 3];
        }
        // Two axes have twice the noise of one, and twice the deviation of a sum of squares is the benefit of the doubt.
        let shown = own[0] + own[2] - 2.0 * own[3] * (1.0 - 2.0 * (1.0 / own[5]).sqrt());
        if shown < OWN_MIN * (xx + yy - 2.0 * noise) * own[5] / count {
            return [0.0; 3];
        }
        // What noise alone makes of a sum of squares, and twice the deviation of that.
        let floor = noise * (1.0 + 2.0 * (2.0 / count).sqrt());
        // Both frames are noisy; without any noise a thousandth of white keeps the figure finite.
        let both = 2.0 * (variance / count).max(1e-6) * (BIN * BIN) as f64;
        [(xx - floor).max(0.0) / both, xy / both, (yy - floor).max(0.0) / both]
    }
}

/// The least deviation of a displacement along the direction that the texture shows best, developed pixels.
pub(super) fn best_sd([xx, xy, yy]: Information) -> f64 {
    let most = 0.5 * (xx + yy) + (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
    if most > 0.0 { (1.0 / most).sqrt() } else { f64::INFINITY }
}

/// The deviation along a direction where only that direction is looked for, developed pixels.
pub(super) fn sd_along([xx, xy, yy]: Information, [dx, dy]: [f64; 2]) -> f64 {
    let known = xx * dx * dx + 2.0 * xy * dx * dy + yy * dy * dy;
    if known > 0.0 { (1.0 / known).sqrt() } else { f64::INFINITY }
}
