//! Long lines and edges in one frame: no cell of the flow can hold a wire, which is a pixel wide and hundreds long.
//!
//! The image is summed along short pieces of line, TILE pixels long, of every slope (a discrete Radon transform by tiles);
//! a piece is a ridge where the sum is above, or below, what lies beside it on both sides, and an edge where the two sides
//! differ. Pieces that lie on one line make a line, also where what is behind hides some of them.

use super::heading::MEDIAN_ABS;
use crate::{exposure::Exposed, motion::lens::Lens};

/// Length of a piece, developed pixels.
const TILE: usize = 24;
/// Slopes from −1 to 1: over half a piece two neighbours part by half a pixel.
const SLOPES: i32 = 16;
/// What lies beside a ridge is looked at this far from its middle, developed pixels: a wire is narrower.
const BESIDE: usize = 2;
/// How strong a ridge is counts against the median of what is within this many pixels of it.
const AROUND: usize = 12;
/// A piece stands out by so many deviations of what is around it, …
const STRENGTH_MIN: f32 = 3.0;
/// … and by this part of white.
const CONTRAST_MIN: f32 = 0.004;
/// One piece counts for no more than this, or a kerb would make a line with anything.
const STRENGTH_MAX: f32 = 8.0;
/// Pieces that are kept of each tile.
const PEAKS: usize = 6;
/// Pieces lie on a line within this, pixels, and have its slope within this.
const ON_LINE_PX: f64 = 0.8;
const ON_LINE_SLOPE: f64 = 0.08;
/// The fewest pieces of a line.
const PIECES_MIN: usize = 4;
/// Lines that are looked for: level and upright ones, lines and edges, each.
const LINES_MAX: usize = 4;
/// An edge this near to a line, developed pixels, is the line's.
const EDGES_PX: f64 = 4.0;

/// A line, as rays (x, y, 1) of its two ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ridge {
    pub(super) ends: [[f64; 2]; 2],
    /// Brighter than what is beside it, or darker; of an edge, brighter to the right of it or below.
    pub(super) bright: bool,
    /// An edge: something else begins there.
    pub(super) edge: bool,
}

impl Ridge {
    /// Whether both ends of another one are within so much of the line through this one's.
    fn beside(&self, other: &Ridge, apart: f64) -> bool {
        let [[x, y], [to_x, to_y]] = self.ends;
        let (along, across) = (to_x - x, to_y - y);
        let length = (along * along + across * across).sqrt();
        other.ends.iter().all(|end| ((end[1] - y) * along - (end[0] - x) * across).abs() < apart * length)
    }
}

/// What is looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Line,
    Edge,
}

const KINDS: [Kind; 2] = [Kind::Line, Kind::Edge];
/// What is looked at around a place, developed pixels to either side.
const MARGIN: usize = BESIDE + 1;

/// The strongest piece through a place of a tile's middle.
#[derive(Debug, Clone, Copy, Default)]
struct Piece {
    /// Signed, in deviations of what is around it.
    strength: f32,
    slope: f32,
}

/// A piece that stands out, its middle freed from the lens' distortion.
#[derive(Debug, Clone, Copy)]
struct Peak {
    tile: usize,
    /// Along and across, developed pixels from the optical axis.
    at: [f64; 2],
    slope: f64,
    strength: f32,
    used: bool,
}

/// Scratch memory.
#[derive(Debug, Default)]
pub(super) struct Ridges {
    /// Green, so that what lies across the lines is contiguous: along × across.
    plane: Vec<f32>,
    breadth: usize,
    sums: Vec<f32>,
    usual: Vec<f32>,
    window: Vec<f32>,
    tops: Vec<usize>,
    /// By kind.
    spread: [Vec<f32>; 2],
    pieces: [Vec<Piece>; 2],
    peaks: [Vec<Peak>; 2],
}

impl Ridges {
    /// Appends what a developed frame shows.
    pub(super) fn find(&mut self, image: &Exposed, lens: &Lens, found: &mut Vec<Ridge>) {
        let focal = lens.focal() / f64::from(image.scale[0]);
        for upright in [false, true] {
            self.lay(image, upright);
            self.peaks.iter_mut().for_each(Vec::clear);
            let tiles = if upright { image.height } else { image.width } / TILE;
            for tile in 0..tiles {
                let middle = (tile * TILE) as f64 + 0.5 * (TILE as f64 - 1.0);
                let freed = |across: f64| {
                    let at = if upright { [across, middle] } else { [middle, across] };
                    let pixel = [0, 1].map(|i| (at[i] + 0.5) * f64::from(image.scale[i]) - 0.5);
                    let ray = lens.ray(pixel)?.map(|side| side * focal);
                    Some(if upright { [ray[1], ray[0]] } else { ray })
                };
                self.search(tile);
                KINDS.iter().for_each(|kind| self.stand_out(tile, *kind, freed));
            }
            for kind in KINDS {
                let lines = std::iter::from_fn(|| line(&mut self.peaks[kind as usize])).take(LINES_MAX);
                for (bright, ends) in lines {
                    let ray = |[along, across]: [f64; 2]| if upright { [across, along] } else { [along, across] };
                    let ends = ends.map(|end| ray(end).map(|side| side / focal));
                    let ridge = Ridge { bright, edge: kind == Kind::Edge, ends };
                    // A line's own two edges are no more than the line.
                    if !found.iter().any(|line| ridge.edge && !line.edge && line.beside(&ridge, EDGES_PX / focal)) {
                        found.push(ridge);
                    }
                }
            }
        }
    }

    /// Green, by columns where lines run across the image, by rows where they stand: red and blue of a developed pixel are
    /// of other rows, so that in grey every edge between two colours has a dark line along it.
    fn lay(&mut self, image: &Exposed, upright: bool) {
        let (width, height) = (image.width, image.height);
        let size = width * height;
        self.breadth = if upright { width } else { height };
        self.plane.clear();
        self.plane.resize(size, 0.0);
        let green = image.rgb.get(size..2 * size).unwrap_or_default();
        for (at, value) in green.iter().enumerate() {
            let place = if upright { at } else { at % width * height + at / width };
            self.plane[place] = *value;
        }
    }

    /// The strongest pieces through each place of the tile's middle line.
    fn search(&mut self, tile: usize) {
        let breadth = self.breadth;
        self.sum(tile, 0.0);
        for kind in KINDS {
            self.scale(kind);
            self.pieces[kind as usize].clear();
            self.pieces[kind as usize].resize(breadth, Piece::default());
        }
        for step in -SLOPES..=SLOPES {
            let slope = step as f32 / SLOPES as f32;
            self.sum(tile, slope);
            let margin = MARGIN + (slope.abs() * 0.5 * TILE as f32).ceil() as usize;
            let inside = margin..breadth.saturating_sub(margin);
            for kind in KINDS.into_iter().filter(|_| !inside.is_empty()) {
                let near = around(&self.sums[inside.start - MARGIN..inside.end + MARGIN]);
                let pieces = &mut self.pieces[kind as usize][inside.clone()];
                for ((near, spread), piece) in near.zip(&self.spread[kind as usize][inside.clone()]).zip(pieces) {
                    let over = kind.over(near);
                    let strength = over / spread;
                    if over.abs() >= CONTRAST_MIN && strength.abs() > piece.strength.abs() {
                        *piece = Piece { strength, slope };
                    }
                }
            }
        }
    }

    /// Means along pieces of one slope, by where they cross the tile's middle; what leaves the image is left out.
    fn sum(&mut self, tile: usize, slope: f32) {
        let breadth = self.breadth;
        self.sums.clear();
        self.sums.resize(breadth, 0.0);
        for along in 0..TILE {
            let shift = (slope * (along as f32 - 0.5 * (TILE as f32 - 1.0))).round() as isize;
            let line = &self.plane[(tile * TILE + along) * breadth..][..breadth];
            let aside = shift.unsigned_abs().min(breadth);
            let (to, from) = match shift >= 0 {
                true => (&mut self.sums[..breadth - aside], &line[aside..]),
                false => (&mut self.sums[aside..], &line[..breadth - aside]),
            };
            for (sum, value) in to.iter_mut().zip(from) {
                *sum += value * (1.0 / TILE as f32);
            }
        }
    }

    /// What is usual around each place: noise in the sky, texture on the ground.
    fn scale(&mut self, kind: Kind) {
        let breadth = self.breadth;
        let spread = &mut self.spread[kind as usize];
        spread.clear();
        spread.resize(breadth, f32::INFINITY);
        self.usual.clear();
        self.usual.extend(around(&self.sums).map(|near| kind.usual(near).abs()));
        let usual = &self.usual;
        for (at, spread) in (MARGIN..).zip(&mut spread[MARGIN.min(breadth)..]).take(usual.len()) {
            let place = at - MARGIN;
            self.window.clear();
            self.window.extend_from_slice(&usual[place.saturating_sub(AROUND)..(place + AROUND + 1).min(usual.len())]);
            let middle = self.window.len() / 2;
            let (_, median, _) = self.window.select_nth_unstable_by(middle, f32::total_cmp);
            *spread = (*median / MEDIAN_ABS as f32).max(1e-6);
        }
    }

    /// Keeps the tile's strongest pieces.
    fn stand_out(&mut self, tile: usize, kind: Kind, freed: impl Fn(f64) -> Option<[f64; 2]>) {
        let pieces = std::mem::take(&mut self.pieces[kind as usize]);
        let strength = |y: usize| pieces.get(y).map_or(0.0, |piece| piece.strength.abs());
        self.tops.clear();
        self.tops.extend((0..pieces.len()).filter(|y| {
            let own = strength(*y);
            let top =
                (y.saturating_sub(2)..*y).all(|y| strength(y) < own) && (y + 1..y + 3).all(|y| strength(y) <= own);
            own >= STRENGTH_MIN && top
        }));
        self.tops.sort_unstable_by(|a, b| strength(*b).total_cmp(&strength(*a)).then(a.cmp(b)));
        self.tops.truncate(PEAKS);
        let tops = std::mem::take(&mut self.tops);
        for y in tops.iter().copied() {
            let Piece { strength, slope } = pieces[y];
            self.sum(tile, slope);
            let offset = self.sums[y - MARGIN..].first_chunk().map_or(0.0, |near| kind.offset(near));
            if let Some(at) = freed(y as f64 + f64::from(offset)) {
                let peak = Peak { tile, at, slope: f64::from(slope), strength, used: false };
                self.peaks[kind as usize].push(peak);
            }
        }
        (self.pieces[kind as usize], self.tops) = (pieces, tops);
    }
}

/// What lies around each place that has so much around it.
fn around(sums: &[f32]) -> impl Iterator<Item = &[f32; 2 * MARGIN + 1]> {
    sums.windows(2 * MARGIN + 1).filter_map(|near| near.first_chunk())
}

/// The line on which the strongest pieces lie that no line has yet: whether it is bright, and where it begins and ends.
fn line(peaks: &mut [Peak]) -> Option<(bool, [[f64; 2]; 2])> {
    let mut best = None::<(f32, usize, f64)>;
    for (i, p) in peaks.iter().enumerate() {
        for q in peaks.iter().filter(|q| q.tile >= p.tile + 2) {
            let slope = (q.at[1] - p.at[1]) / (q.at[0] - p.at[0]);
            if !q.on(p, slope) || !p.on(p, slope) {
                continue;
            }
            let (mut score, mut pieces) = (0.0, 0);
            along(peaks, p, slope, |peak| {
                (score, pieces) = (score + peak.strength.abs().min(STRENGTH_MAX), pieces + 1);
            });
            if pieces >= PIECES_MIN && best.is_none_or(|best| score > best.0) {
                best = Some((score, i, slope));
            }
        }
    }
    let (_, index, slope) = best?;
    let seed = peaks[index];
    let (mut n, mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
    let mut reach = [f64::INFINITY, f64::NEG_INFINITY];
    along(peaks, &seed, slope, |peak| {
        let [along, across] = peak.at;
        (n, x, y, xx, xy) = (n + 1.0, x + along, y + across, xx + along * along, xy + along * across);
        reach = [reach[0].min(along), reach[1].max(along)];
    });
    let slope = (n * xy - x * y) / (n * xx - x * x);
    let at = |along: f64| [along, (y + slope * (n * along - x)) / n];
    for peak in peaks {
        peak.used |= (peak.at[1] - at(peak.at[0])[1]).abs() < 3.0 * ON_LINE_PX;
    }
    let half = 0.5 * TILE as f64;
    Some((seed.strength > 0.0, [at(reach[0] - half), at(reach[1] + half)]))
}

/// The strongest piece of each tile on the line through `seed`.
fn along(peaks: &[Peak], seed: &Peak, slope: f64, mut take: impl FnMut(&Peak)) {
    let mut next = 0;
    for peak in peaks {
        if peak.tile >= next && peak.on(seed, slope) {
            // A tile's pieces stand in the order of their strength.
            next = peak.tile + 1;
            take(peak);
        }
    }
}

impl Peak {
    /// Whether it lies on the line through `seed`.
    fn on(&self, seed: &Peak, slope: f64) -> bool {
        let off = self.at[1] - seed.at[1] - slope * (self.at[0] - seed.at[0]);
        !self.used
            && seed.strength * self.strength > 0.0
            && off.abs() < ON_LINE_PX
            && (self.slope - slope).abs() < ON_LINE_SLOPE
    }
}

impl Kind {
    /// By how much the middle of means around a place is above, or below, both sides, 0 between them; or by how much the
    /// side after it is above the side before.
    fn over(self, near: &[f32; 2 * MARGIN + 1]) -> f32 {
        let [_, low, _, own, _, high, _] = *near;
        match self {
            Kind::Line if (own - low) * (own - high) > 0.0 => {
                (own - low).abs().min((own - high).abs()).copysign(own - low)
            }
            Kind::Line => 0.0,
            Kind::Edge => self.usual(near),
        }
    }

    /// The same for what is usual, where the middle may be between both sides.
    fn usual(self, [lowest, low, _, own, _, high, highest]: &[f32; 2 * MARGIN + 1]) -> f32 {
        match self {
            Kind::Line => own - 0.5 * (low + high),
            Kind::Edge => 0.5 * ((high + highest) - (lowest + low)),
        }
    }

    /// From a place to the centroid of what is above, or below, the line between both sides; or to that of the gradient.
    fn offset(self, [_, low, before, own, after, high, _]: &[f32; 2 * MARGIN + 1]) -> f32 {
        match self {
            Kind::Line => {
                let (tilt, floor) = ((high - low) / (2 * BESIDE) as f32, 0.5 * (low + high));
                let (before, own, after) = (before - floor + tilt, own - floor, after - floor - tilt);
                let sum = before + own + after;
                if sum * own > 0.0 { ((after - before) / sum).clamp(-0.6, 0.6) } else { 0.0 }
            }
            Kind::Edge => {
                let rise = high - low;
                let first = -1.5 * (before - low) - 0.5 * (own - before) + 0.5 * (after - own) + 1.5 * (high - after);
                if rise.abs() > 1e-6 { (first / rise).clamp(-2.0, 2.0) } else { 0.0 }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::wire::CameraInfo;

    const SIZE: [usize; 2] = [320, 240];
    const FOCAL: f64 = 211.0;

    fn lens(d: &[f64]) -> Lens {
        let k = [2.0 * FOCAL, 0.0, 319.5, 0.0, 2.0 * FOCAL, 239.5, 0.0, 0.0, 1.0];
        let info = CameraInfo { k, d: d.to_vec(), distortion_model: "plumb_bob".into(), ..CameraInfo::default() };
        Lens::read(&info).unwrap().unwrap()
    }

    /// A frame of half the camera's size; `value` gives a colour (0…2) at a pixel (column, row) of it.
    fn frame(seed: u64, noise: f32, value: impl Fn(usize, [f64; 2]) -> f64) -> Exposed {
        let mut draws = ChaCha8Rng::seed_from_u64(seed);
        let mut noisy = |clean: f64| clean as f32 + noise * (0..12).map(|_| draws.random::<f32>() - 0.5).sum::<f32>();
        let pixels = (0..SIZE[0] * SIZE[1]).map(|at| [(at % SIZE[0]) as f64, (at / SIZE[0]) as f64]);
        let rgb = (0..3).flat_map(|colour| pixels.clone().map(move |at| (colour, at)));
        let rgb = rgb.map(|(colour, at)| noisy(value(colour, at))).collect();
        Exposed { width: SIZE[0], height: SIZE[1], scale: [2.0; 2], rgb, ..Exposed::default() }
    }

    fn find(frame: &Exposed, lens: &Lens) -> Vec<Ridge> {
        let mut found = vec![];
        Ridges::default().find(frame, lens, &mut found);
        found
    }

    /// How much of a pixel a line as wide as it covers, `aside` pixels from its middle.
    fn covered(aside: f64) -> f64 {
        (1.0 - aside.abs()).clamp(0.0, 1.0)
    }

    /// Rays of the ends, as pixels of the frame.
    fn pixels(ridge: &Ridge) -> [[f64; 2]; 2] {
        ridge.ends.map(|[x, y]| [x * FOCAL + 159.5, y * FOCAL + 119.5])
    }

    #[test]
    fn lines_of_every_slope_are_found_to_a_tenth_of_a_pixel() {
        // A point of each line and its direction, degrees against the rows.
        for (x, y, degrees) in [(160.0, 60.3, 0.0), (160.0, 101.7, 12.0), (150.2, 120.0, 33.0), (90.6, 120.0, 88.0)] {
            for contrast in [-0.2, 0.2] {
                let (sine, cosine) = f64::to_radians(degrees).sin_cos();
                let aside = |[u, v]: [f64; 2]| (v - y) * cosine - (u - x) * sine;
                let frame = frame(7, 0.05, |_, at| 0.4 + contrast * covered(aside(at)));
                let found = find(&frame, &lens(&[]));
                let near = |ridge: &&Ridge| pixels(ridge).iter().all(|end| aside(*end).abs() < 0.3);
                assert!(found.iter().all(|ridge| !near(&ridge) || !ridge.edge), "its edges are its own: {found:?}");
                let ridge = found.iter().find(near).unwrap_or_else(|| panic!("{degrees}°: {found:?}"));
                assert_eq!(ridge.bright, contrast > 0.0);
                let ends = pixels(ridge);
                let middle = [0, 1].map(|i| 0.5 * (ends[0][i] + ends[1][i]));
                assert!(aside(middle).abs() < 0.1, "{degrees}°: {} px aside", aside(middle));
                let length = ((ends[1][0] - ends[0][0]).powi(2) + (ends[1][1] - ends[0][1]).powi(2)).sqrt();
                assert!(length > 150.0, "{degrees}°: {length} pixels of it");
            }
        }
    }

    #[test]
    fn a_line_that_the_lens_bends_is_straight() {
        let lens = lens(&[-0.25, 0.08, 0.0, 0.0, 0.0]);
        let y = 0.25;
        let aside = |at: [f64; 2]| match lens.ray(at.map(|side| 2.0 * side + 0.5)) {
            Some(ray) => (ray[1] - y) * FOCAL,
            None => f64::INFINITY,
        };
        let found = find(&frame(3, 0.02, |_, at| 0.4 - 0.2 * covered(aside(at))), &lens);
        let long = found.iter().max_by(|a, b| (a.ends[1][0] - a.ends[0][0]).total_cmp(&(b.ends[1][0] - b.ends[0][0])));
        let ends = long.unwrap().ends;
        assert!(ends.iter().all(|end| (end[1] - y).abs() < 0.5 / FOCAL), "{ends:?}");
        assert!(ends[1][0] - ends[0][0] > 1.2, "all of the width: {ends:?}");
    }

    #[test]
    fn an_edge_is_no_line_and_neither_is_the_seam_of_two_colours() {
        let edge = |_, [_, v]: [f64; 2]| if v < 100.0 { 0.5 } else { 0.3 };
        let found = find(&frame(1, 0.01, edge), &lens(&[]));
        assert!(!found.is_empty() && found.iter().all(|ridge| ridge.edge && !ridge.bright), "{found:?}");
        assert!(found.iter().flat_map(pixels).all(|end| (end[1] - 99.5).abs() < 0.1), "{found:?}");
        // Below a horizon between two rows of the camera red is of the sky and blue of the ground.
        let seam = |colour: usize, [_, v]: [f64; 2]| match (colour, v == 100.0) {
            (1, _) => 0.4,
            (_, true) => 0.2,
            _ => 0.4,
        };
        assert_eq!(find(&frame(1, 0.01, seam), &lens(&[])), []);
    }

    #[test]
    fn noise_alone_hardly_makes_a_line() {
        let count: usize = (0..20).map(|seed| find(&frame(seed, 0.1, |_, _| 0.4), &lens(&[])).len()).sum();
        assert!(count <= 10, "{count} lines in twenty frames of noise");
        assert_eq!(find(&frame(1, 0.0, |_, _| 0.4), &lens(&[])), [], "nor nothing at all");
    }

    #[test]
    fn a_frame_smaller_than_a_piece_shows_none() {
        for [width, height] in [[0, 0], [1, 1], [4, 23], [24, 3], [96, 2]] {
            let rgb = vec![0.4; 3 * width * height];
            let frame = Exposed { width, height, scale: [2.0; 2], rgb, ..Exposed::default() };
            assert_eq!(find(&frame, &lens(&[])), []);
        }
    }
}
