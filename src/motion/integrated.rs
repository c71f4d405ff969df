//! The flow straight below in an autopilot's form: angles about the body's axes, and the gyro over the same interval.
//!
//! Two views of a plane are joined by a homography, whatever the camera did between them. It is fitted to the dense
//! flow without the gyro's word, so that an autopilot which takes its own gyro off loses nothing, and is then asked for
//! one ray: the body's own down.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::{
    Config, Odometer,
    fit::{CUT, MEDIAN_LENGTH, SPREAD_MIN},
    lens::Lens,
};
use crate::{
    clock::Stamp,
    flow::{Flow, Grid},
};

/// The most vectors that are looked at: neighbours are alike, and the two angles need no more.
const PAIRS_MAX: usize = 600;
/// Rounds that weigh by the inverse of the residual, which no start can lead astray, and then Tukey's.
const ROUNDS: [usize; 2] = [4, 3];

/// What an autopilot's optical flow message holds, for one step. Body axes FRD (x forward, y right, z down).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Integrated {
    /// Stamp of the older frame: the integration begins.
    pub older: Stamp,
    /// Stamp of the newer frame: the integration ends.
    pub newer: Stamp,
    /// rad about the body's X and Y, the gyro's part not taken off. A turn of the vehicle by the right hand about an
    /// axis counts positive; so does flying forward about Y and flying left about X.
    pub flow: Result<[f64; 2], NoFlow>,
    /// rad, the body's rates integrated over exactly the interval; `None` where the gyro does not cover it.
    pub gyro: Option<[f64; 3]>,
    /// Metres along the body's down to the ground at the older frame; `None` where it is not known.
    pub distance: Option<f64>,
    /// Camera pixels per radian at the centre; `None` without a calibration.
    pub focal_px: Option<f64>,
    /// 0 where there is no flow; otherwise 1…255: 255 × part of the vectors that agree × their mean confidence.
    pub quality: u8,
}

/// Why there is no flow straight below.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum NoFlow {
    /// The flow is not to be trusted.
    #[error("blind")]
    Blind,
    /// No CameraInfo, or one that says "uncalibrated", or one for frames of another size.
    #[error("no calibration for frames of {frame:?} (columns, rows)")]
    Calibration {
        /// Columns and rows of the frame.
        frame: [u32; 2],
    },
    /// It is not known how the camera sits.
    #[error("no transform from the camera's frame to the body's was received")]
    Mount,
    /// The camera does not look there.
    #[error("what is straight below the body is not in the camera's sight")]
    OutOfSight,
    /// Too few vectors agree on one plane.
    #[error("{inliers} of {samples} flow vectors agree on one plane, at least {needed} are needed")]
    Disagreement {
        /// That agreed.
        inliers: u32,
        /// That were offered.
        samples: u32,
        /// The limit.
        needed: u32,
    },
    /// The fit has no unique solution.
    #[error("the flow vectors do not determine a plane")]
    Degenerate,
}

/// One vector as rays (x, y, 1) of its two ends.
#[derive(Debug, Clone, Copy)]
struct Pair {
    from: [f64; 2],
    to: [f64; 2],
    /// Inverse variance by the confidence, relative.
    weight: f64,
    confidence: f64,
    /// Residual's length, radians.
    off: f64,
}

/// The raster of vectors and its scratch memory, kept from step to step.
#[derive(Debug, Default)]
pub(super) struct Below {
    /// Rays of the raster's cells, and the raster and lens that they belong to.
    rays: Vec<Option<[f64; 2]>>,
    rays_of: Option<(Grid, Lens)>,
    pairs: Vec<Pair>,
    scratch: Vec<f64>,
}

/// What the fit found.
struct Found {
    /// Brings rays of the older frame to rays of the newer one, up to their length.
    homography: Matrix3<f64>,
    /// The least and the greatest ray among those that agree.
    sight: [[f64; 2]; 2],
    quality: u8,
}

impl Odometer {
    /// The flow straight below between two frames of `camera_size` (columns, rows). Blind flow is no flow, but the gyro
    /// and the distance stand by themselves.
    pub fn integrated(&mut self, flow: &Flow<'_>, camera_size: [u32; 2], blind: bool) -> Integrated {
        let span = self.span(flow);
        let gyro = self.rates.turn(span.older, span.newer, &self.config).ok().map(|turn| turn.mean * span.seconds);
        let ground = self.ground(span);
        let cosine = -ground.normal.z;
        let distance = ground.distance.ok().map(|d| d.metres / cosine).filter(|_| cosine > 0.1);
        let found = if blind { Err(NoFlow::Blind) } else { self.plane(flow, camera_size) };
        let quality = found.as_ref().map_or(0, |found| found.quality.max(1));
        let below = found.and_then(|found| self.below(&found));
        Integrated {
            flow: below,
            gyro: gyro.map(|angle| [angle.x, -angle.y, -angle.z]),
            distance,
            focal_px: self.lens.as_ref().map(Lens::focal),
            quality: if below.is_ok() { quality } else { 0 },
            ..Integrated::without(flow.older, flow.newer, NoFlow::Blind)
        }
    }

    fn plane(&mut self, flow: &Flow<'_>, camera_size: [u32; 2]) -> Result<Found, NoFlow> {
        if !self.mounted {
            return Err(NoFlow::Mount);
        }
        let fits = |lens: &&Lens| lens.size() == [0, 0] || lens.size() == camera_size;
        let lens = self.lens.as_ref().filter(fits).ok_or(NoFlow::Calibration { frame: camera_size })?;
        self.below.look(flow, lens, self.config.confidence_min);
        self.below.solve(&self.config)
    }

    /// How far the body's down moved, forward from the older frame and back from the newer one. Their mean belongs to
    /// the axes in the middle, as the integral of the gyro does: a yaw in between turns the two apart alike.
    fn below(&self, found: &Found) -> Result<[f64; 2], NoFlow> {
        let down = self.mount.inverse() * -Vector3::z();
        let at = [down.x / down.z, down.y / down.z];
        let [least, most] = found.sight;
        if down.z <= 0.0 || (0..2).any(|i| at[i] < least[i] || at[i] > most[i]) {
            return Err(NoFlow::OutOfSight);
        }
        let back = found.homography.try_inverse().ok_or(NoFlow::Degenerate)?;
        let ray = Vector3::new(at[0], at[1], 1.0);
        // Angles about the FRD axes; `mount` leads to FLU.
        let angles = |ray: Vector3<f64>| {
            let body = self.mount * ray;
            [(-body.y).atan2(-body.z), -body.x.atan2(-body.z)]
        };
        let (ahead, behind) = (angles(found.homography * ray), angles(back * ray));
        Ok(std::array::from_fn(|i| 0.5 * (ahead[i] - behind[i])))
    }
}

impl Integrated {
    /// Nothing is known of the interval, and why there is no flow.
    pub fn without(older: Stamp, newer: Stamp, why: NoFlow) -> Self {
        Self { older, newer, flow: Err(why), gyro: None, distance: None, focal_px: None, quality: 0 }
    }
}

impl Below {
    /// Takes the vectors that may be used, evenly thinned.
    fn look(&mut self, flow: &Flow<'_>, lens: &Lens, confidence_min: f64) {
        let grid = flow.grid;
        let mut step = 1;
        while grid.width.div_ceil(step) * grid.height.div_ceil(step) > PAIRS_MAX {
            step += 1;
        }
        let cells = || {
            let rows = (step / 2..grid.height.max(step / 2 + 1)).step_by(step);
            rows.flat_map(move |row| (step / 2..grid.width.max(step / 2 + 1)).step_by(step).map(move |col| (col, row)))
        };
        let middle = |i: usize, scale: f32| (i as f64 + 0.5) * f64::from(scale) - 0.5;
        let pixel = |(column, row)| [middle(column, grid.scale[0]), middle(row, grid.scale[1])];
        if !self.rays_of.as_ref().is_some_and(|(of, by)| *of == grid && by == lens) {
            self.rays_of = Some((grid, lens.clone()));
            self.rays.clear();
            self.rays.extend(cells().map(|cell| lens.ray(pixel(cell))));
        }
        self.pairs.clear();
        self.pairs.extend(cells().zip(&self.rays).filter_map(|(place, ray)| {
            let cell = place.1 * grid.width + place.0;
            let confidence = f64::from(*flow.confidence.get(cell)?);
            let [u, v] = *flow.vectors.get(2 * cell..2 * cell + 2)? else { return None };
            if confidence < confidence_min || !u.is_finite() || !v.is_finite() {
                return None;
            }
            let [x, y] = pixel(place);
            let to = lens.ray([x + f64::from(u), y + f64::from(v)])?;
            // A probability p of being right to within a pixel is a Gaussian of variance −1 / (2 ln(1 − p)) px².
            let weight = -2.0 * (1.0 - confidence.min(0.999)).ln();
            Some(Pair { from: (*ray)?, to, weight, confidence, off: 0.0 })
        }));
    }

    /// Iteratively re-weighted least squares: first towards the least sum of lengths, then under Tukey's weight.
    fn solve(&mut self, config: &Config) -> Result<Found, NoFlow> {
        let samples = self.pairs.len() as u32;
        let needed = config.inliers_min.max((f64::from(samples) * config.inlier_part_min).ceil() as u32);
        if samples < needed {
            return Err(NoFlow::Disagreement { inliers: samples, samples, needed });
        }
        let mut homography = self.weigh(|_| 1.0).ok_or(NoFlow::Degenerate)?;
        let mut spread = self.measure(&homography, f64::INFINITY);
        for _ in 0..ROUNDS[0] {
            let floor = 0.1 * spread;
            homography =
                self.weigh(|pair| 1.0 / (pair.off * pair.weight.sqrt()).max(floor)).ok_or(NoFlow::Degenerate)?;
            spread = self.measure(&homography, f64::INFINITY);
        }
        // Tukey's weight, 0 beyond the cut.
        let agrees = |pair: &Pair, spread: f64| match pair.weight * (pair.off / (CUT * spread)).powi(2) {
            part if part < 1.0 && pair.off <= config.agree_rad_max => (1.0 - part).powi(2),
            _ => 0.0,
        };
        for _ in 0..ROUNDS[1] {
            homography = self.weigh(|pair| agrees(pair, spread)).ok_or(NoFlow::Degenerate)?;
            spread = self.measure(&homography, CUT * spread);
        }
        let (mut inliers, mut confidence) = (0, 0.0);
        let mut sight = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        for pair in self.pairs.iter().filter(|pair| agrees(pair, spread) > 0.0) {
            inliers += 1;
            confidence += pair.confidence.min(1.0);
            for (i, at) in pair.from.into_iter().enumerate() {
                sight[0][i] = sight[0][i].min(at);
                sight[1][i] = sight[1][i].max(at);
            }
        }
        if inliers < needed {
            return Err(NoFlow::Disagreement { inliers, samples, needed });
        }
        let quality = (255.0 * confidence / f64::from(samples)).round() as u8;
        Ok(Found { homography, sight, quality })
    }

    /// One round of weighted least squares over x₂(h₆x + h₇y + 1) = h₀x + h₁y + h₂, and the same in y.
    fn weigh(&self, factor: impl Fn(&Pair) -> f64) -> Option<Matrix3<f64>> {
        // Upper triangles of the rays' squares: xx, xy, x, yy, y, 1; plain, and times x₂, y₂ and x₂² + y₂².
        let mut sums = [[0.0; 6]; 4];
        for pair in &self.pairs {
            let weight = pair.weight * factor(pair);
            let ([x, y], [x2, y2]) = (pair.from, pair.to);
            let square = [x * x, x * y, x, y * y, y, 1.0];
            for (sum, by) in sums.iter_mut().zip([weight, weight * x2, weight * y2, weight * (x2 * x2 + y2 * y2)]) {
                for (one, part) in sum.iter_mut().zip(square) {
                    *one += by * part;
                }
            }
        }
        let [plain, by_x, by_y, by_both] =
            sums.map(|[xx, xy, x, yy, y, one]| Matrix3::new(xx, xy, x, xy, yy, y, x, y, one));
        let mut normal = SMatrix::<f64, 8, 8>::zeros();
        normal.fixed_view_mut::<3, 3>(0, 0).copy_from(&plain);
        normal.fixed_view_mut::<3, 3>(3, 3).copy_from(&plain);
        for (row, by) in [(0, &by_x), (3, &by_y)] {
            let cross = -by.fixed_columns::<2>(0);
            normal.fixed_view_mut::<3, 2>(row, 6).copy_from(&cross);
            normal.fixed_view_mut::<2, 3>(6, row).copy_from(&cross.transpose());
        }
        normal.fixed_view_mut::<2, 2>(6, 6).copy_from(&by_both.fixed_view::<2, 2>(0, 0));
        let mut right = SVector::<f64, 8>::zeros();
        right.fixed_rows_mut::<3>(0).copy_from(&by_x.column(2));
        right.fixed_rows_mut::<3>(3).copy_from(&by_y.column(2));
        right.fixed_rows_mut::<2>(6).copy_from(&-by_both.fixed_view::<2, 1>(0, 2));
        let h = normal.cholesky()?.solve(&right);
        let homography = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0);
        homography.iter().all(|value| value.is_finite()).then_some(homography)
    }

    /// Residuals, and their spread for a vector of weight 1 by the median over those within `cut`.
    fn measure(&mut self, homography: &Matrix3<f64>, cut: f64) -> f64 {
        self.scratch.clear();
        for pair in &mut self.pairs {
            let there = homography * Vector3::new(pair.from[0], pair.from[1], 1.0);
            let off = [there.x / there.z - pair.to[0], there.y / there.z - pair.to[1]];
            pair.off = (off[0] * off[0] + off[1] * off[1]).sqrt();
            let scaled = pair.off * pair.weight.sqrt();
            if scaled <= cut {
                self.scratch.push(scaled);
            }
        }
        if self.scratch.is_empty() {
            return SPREAD_MIN;
        }
        let middle = self.scratch.len() / 2;
        let (_, median, _) = self.scratch.select_nth_unstable_by(middle, f64::total_cmp);
        (*median / MEDIAN_LENGTH).max(SPREAD_MIN)
    }
}
