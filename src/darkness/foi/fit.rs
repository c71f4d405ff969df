//! The line through the levels: variance a·y + b by maximum likelihood, and how sure it is.

use nalgebra::{Matrix2, Vector2};

use super::{
    clip::Clip,
    levels::{Level, MEDIAN_SPREAD, SETS_MIN},
};

/// Variance of a mean over a window's coefficients, times their number over σ²: local means carry σ/2.
const MEAN_SPREAD: f64 = 0.25;
/// Part of the levels that may be off (texture that was not told from noise), and how many deviations then.
const OUTLIERS: [f64; 2] = [0.1, 10.0];
/// By how much, as a part of the variance, the levels' deviations are off together (pixels of unlike brightness in one set,
/// texture that all sets share): seen in simulation, and not in the scatter of the levels.
const MODEL_SD: f64 = 0.02;
/// Levels this close to the upper edge, as a part of the range, hold pixels that stand on it.
const MARGIN: f64 = 0.02;
const STEPS_MAX: usize = 400;

/// Two variances that stand for a line: at a dark and at a bright anchor. As logarithms, they keep the variance positive
/// where it was seen, while b may come out negative.
type Point = Vector2<f64>;

/// Where the line is held.
#[derive(Debug, Clone, Copy)]
struct Anchors {
    dark: f64,
    bright: f64,
}

impl Anchors {
    /// a and b of a point.
    fn line(&self, point: &Point) -> [f64; 2] {
        let [dark, bright] = [point.x.exp(), point.y.exp()];
        let a = (bright - dark) / (self.bright - self.dark);
        [a, dark - a * self.dark]
    }

    fn point(&self, a: f64, b: f64) -> Point {
        let floor = 1e-3 * (a * self.bright + b).max(1e-12);
        Point::new((a * self.dark + b).max(floor).ln(), (a * self.bright + b).max(floor).ln())
    }
}

/// A line and its uncertainty.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Line {
    pub a: f64,
    pub b: f64,
    /// Covariance of a and b.
    pub covariance: Matrix2<f64>,
    /// Mean squared deviation of the levels from the line, in what was expected of them: 1 where the model holds.
    pub misfit: f64,
    pub levels: usize,
}

/// Fits the line; `None` where the levels can't carry one.
pub(super) fn fit(levels: &[Level], clip: Clip) -> Option<Line> {
    let usable: Vec<Level> = unclipped(levels, clip);
    if usable.len() < SETS_MIN {
        return None;
    }
    let anchors = anchors(&usable)?;
    let [a, b] = least_squares(&usable);
    let cost = |point: &Point| cost(&usable, clip, anchors.line(point));
    let best = simplex(anchors.point(a, b), &cost);
    let [a, b] = anchors.line(&best);
    let squares = usable.iter().map(|level| deviations(level, clip, [a, b]).powi(2));
    // The median, so that the outliers that the likelihood allows for do not count again.
    let mut squares: Vec<f64> = squares.collect();
    squares.sort_by(f64::total_cmp);
    let misfit = squares[squares.len() / 2] / 0.455;
    let covariance = fisher(&usable, clip, &anchors, &best)? * misfit.max(1.0) + Matrix2::identity() * MODEL_SD.powi(2);
    // From logarithms at the anchors to a and b.
    let [dark, bright] = [best.x.exp(), best.y.exp()];
    let span = anchors.bright - anchors.dark;
    let turn =
        Matrix2::new(-dark / span, bright / span, dark * (1.0 + anchors.dark / span), -bright * anchors.dark / span);
    Some(Line { a, b, covariance: turn * covariance * turn.transpose(), misfit, levels: usable.len() })
}

/// Levels that stand at an edge tell of clipping more than of noise. Above, where noise only grows, a level has at least
/// the noise of those below it; what looks quieter is clipped in part.
fn unclipped(levels: &[Level], clip: Clip) -> Vec<Level> {
    let mut below: Vec<f64> = Vec::with_capacity(levels.len());
    let mut clear = |level: &&Level| {
        below.sort_by(f64::total_cmp);
        let usual = below.get(below.len() / 2).copied().unwrap_or(0.0).max(level.deviation);
        below.push(level.deviation);
        let room = MARGIN * (clip.high - clip.low) + 2.5 * usual;
        level.deviation > 0.0 && level.mean + room < clip.high && level.mean - level.deviation > clip.low
    };
    levels.iter().filter(|level| clear(level)).copied().collect()
}

/// The means a tenth from either end; `None` where all levels are alike.
fn anchors(levels: &[Level]) -> Option<Anchors> {
    let mut means: Vec<f64> = levels.iter().map(|level| level.mean).collect();
    means.sort_by(f64::total_cmp);
    let [dark, bright] = [means[means.len() / 10], means[means.len() - 1 - means.len() / 10]];
    let noise = levels.iter().map(|level| level.deviation / (level.count as f64).sqrt()).fold(0.0, f64::max);
    (bright - dark > 2.0 * noise).then_some(Anchors { dark, bright })
}

/// The line by weighted least squares on the variances, as a start.
fn least_squares(levels: &[Level]) -> [f64; 2] {
    let mut left = Matrix2::zeros();
    let mut right = Vector2::zeros();
    for level in levels {
        let variance = level.deviation.powi(2);
        // The variance of a variance grows with its square.
        let weight = level.count as f64 / variance.max(1e-20).powi(2);
        let row = Vector2::new(level.mean, 1.0);
        left += weight * row * row.transpose();
        right += weight * row * variance;
    }
    left.try_inverse().map_or([1e-4, 1e-6], |inverse| (inverse * right).into())
}

/// How many deviations the level's noise is from the line's.
fn deviations(level: &Level, clip: Clip, line: [f64; 2]) -> f64 {
    let (expected, spread) = expectation(level, clip, line);
    (level.deviation - expected) / spread
}

/// The deviation that the line lets expect at the level, and by how much the measured one may be off.
///
/// Where the level's true value lies is not known better than its mean is; instead of the integral over it we take its
/// leading term, the slope times that uncertainty.
fn expectation(level: &Level, clip: Clip, [a, b]: [f64; 2]) -> (f64, f64) {
    let noise = |y: f64| (a * y + b).max(1e-14).sqrt();
    let clean = clip.undo(level.mean, noise);
    let [_, expected] = clip.of(clean, noise(clean));
    let slope = 0.5 * a / noise(clean);
    let count = level.count as f64;
    let variance = (MEDIAN_SPREAD + slope * slope * MEAN_SPREAD) * expected * expected / count;
    (expected, variance.sqrt())
}

/// Minus the logarithm of the likelihood.
fn cost(levels: &[Level], clip: Clip, line: [f64; 2]) -> f64 {
    let [part, width] = OUTLIERS;
    levels
        .iter()
        .map(|level| {
            let (expected, spread) = expectation(level, clip, line);
            let off = (level.deviation - expected) / spread;
            let near = (1.0 - part) * (-0.5 * off * off).exp();
            let far = part / width * (-0.5 * (off / width).powi(2)).exp();
            // Far beyond, the logarithm goes on as its tail does.
            spread.ln() - if near + far > 1e-300 { (near + far).ln() } else { -0.5 * (off / width).powi(2) }
        })
        .sum()
}

/// Nelder and Mead's simplex.
fn simplex(start: Point, cost: &impl Fn(&Point) -> f64) -> Point {
    let mut corners = [start, start + Point::new(0.2, 0.0), start + Point::new(0.0, 0.2)].map(|p| (cost(&p), p));
    for _ in 0..STEPS_MAX {
        corners.sort_by(|a, b| a.0.total_cmp(&b.0));
        let [best, middle, worst] = corners;
        if (worst.1 - best.1).norm() < 1e-6 {
            break;
        }
        let centre = 0.5 * (best.1 + middle.1);
        let at = |part: f64| {
            let point = centre + part * (worst.1 - centre);
            (cost(&point), point)
        };
        let mirrored = at(-1.0);
        let next = if mirrored.0 < best.0 {
            let further = at(-2.0);
            if further.0 < mirrored.0 { further } else { mirrored }
        } else if mirrored.0 < middle.0 {
            mirrored
        } else {
            at(if mirrored.0 < worst.0 { -0.5 } else { 0.5 })
        };
        if next.0 < worst.0 {
            corners[2] = next;
        } else {
            for corner in &mut corners[1..] {
                let point = 0.5 * (best.1 + corner.1);
                *corner = (cost(&point), point);
            }
        }
    }
    corners.sort_by(|a, b| a.0.total_cmp(&b.0));
    corners[0].1
}

/// The covariance of the point by the information that the levels give on it, outliers counting for little.
fn fisher(levels: &[Level], clip: Clip, anchors: &Anchors, best: &Point) -> Option<Matrix2<f64>> {
    const STEP: f64 = 0.01;
    let [part, width] = OUTLIERS;
    let mut information = Matrix2::zeros();
    for level in levels {
        let (expected, spread) = expectation(level, clip, anchors.line(best));
        let moved = |x, y| expectation(level, clip, anchors.line(&(best + Point::new(x, y)))).0 - expected;
        let slope = Vector2::new(moved(STEP, 0.0), moved(0.0, STEP)) / STEP / spread;
        let off = (level.deviation - expected) / spread;
        let near = (1.0 - part) * (-0.5 * off * off).exp();
        let far = part / width * (-0.5 * (off / width).powi(2)).exp();
        information += near / (near + far).max(1e-300) * slope * slope.transpose();
    }
    information.try_inverse().filter(|covariance| covariance[(0, 0)] > 0.0 && covariance[(1, 1)] > 0.0)
}
