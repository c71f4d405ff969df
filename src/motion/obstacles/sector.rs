//! A sector's nearest surface out of its cells, and how sectors are followed through time.

use nalgebra::Vector2;

use super::{
    Config, SECTORS, Sector,
    cell::{Cell, Scene},
    surface,
};

/// A sector whose deviation is below this part of the inverse horizon needs no wider view.
const SURE_PART: f64 = 0.3;
/// The part that one surface must fill of each sector of a wider view before it warns.
const WIDE_PART_MIN: f64 = 0.75;

/// What one step says of a sector.
#[derive(Debug, Clone, Copy)]
struct Estimate {
    /// Inverse time to contact, 1/s.
    closing: f64,
    variance: f64,
    /// The surface fills every sector that was looked at.
    filled: bool,
    stretch: f64,
}

/// A sector through time.
#[derive(Debug, Clone, Copy, Default)]
struct Track {
    closing: f64,
    variance: f64,
    stretch: f64,
    /// Seconds since it was measured last; infinite where it never was.
    age_s: f64,
    /// It was measured at all.
    alive: bool,
    /// Enough of it was seen to say that it is free.
    whole: bool,
}

/// All sectors, and scratch memory.
#[derive(Debug)]
pub(super) struct Sectors {
    tracks: [Track; SECTORS],
    /// Yaw that is not yet a whole sector, radians.
    yaw: f64,
    /// Cells that count, sector by sector, and where each sector's begin.
    members: Vec<u32>,
    starts: [usize; SECTORS + 1],
    /// Cells in each sector's corridor, and how many of them were seen.
    shown: [u32; SECTORS],
    seen: [u32; SECTORS],
    order: Vec<u32>,
}

/// What the vehicle's speed makes of corridor and reach.
pub(super) struct Corridor {
    /// m/s where it is metric.
    pub(super) speed: Option<f64>,
    /// 1/s: what is met later is not in the way.
    pub(super) clear: f64,
}

impl Corridor {
    pub(super) fn new(config: &Config, speed: Option<f64>) -> Self {
        let horizon = 1.0 / config.horizon_s;
        let clear = speed.map_or(horizon, |speed| horizon.max(speed / config.reach_m_max));
        Self { speed, clear }
    }

    /// Inverse time at which a ray of this slope leaves the corridor; infinite where nothing is known of it.
    pub(super) fn leaves(&self, config: &Config, slope: f64) -> f64 {
        match self.speed {
            Some(speed) => speed * if slope < 0.0 { -slope / config.below_m } else { slope / config.above_m },
            None if slope.abs() <= config.elevation_rad_max => 0.0,
            None => f64::INFINITY,
        }
    }
}

impl Sectors {
    pub(super) fn new() -> Self {
        Self {
            tracks: [Track::default(); SECTORS],
            yaw: 0.0,
            members: Vec::new(),
            starts: [0; SECTORS + 1],
            shown: [0; SECTORS],
            seen: [0; SECTORS],
            order: Vec::new(),
        }
    }

    /// Nothing is known any more.
    pub(super) fn forget(&mut self) {
        self.tracks = [Track::default(); SECTORS];
        self.yaw = 0.0;
    }

    /// Time passes: what was followed comes nearer, and the body turns under it.
    pub(super) fn predict(&mut self, seconds: f64, yaw: f64, config: &Config) {
        for track in &mut self.tracks {
            track.age_s += seconds;
            track.alive &= track.age_s <= config.delay_s;
            let nearer = 1.0 - track.closing * seconds;
            if nearer > 0.2 {
                track.closing /= nearer;
                track.variance /= nearer.powi(4);
            }
        }
        // What stands to the left comes forward where the body turns left.
        let width = std::f64::consts::TAU / SECTORS as f64;
        self.yaw += yaw;
        let whole = (self.yaw / width).round();
        self.yaw -= whole * width;
        match whole as i64 {
            left @ 1.. => self.tracks.rotate_left(left as usize % SECTORS),
            right => self.tracks.rotate_right(right.unsigned_abs() as usize % SECTORS),
        }
    }

    /// Sorts the cells of a step into their sectors.
    fn gather(&mut self, cells: &[Cell], scene: &Scene<'_>, corridor: &Corridor) {
        (self.shown, self.seen) = ([0; SECTORS], [0; SECTORS]);
        let mut counts = [0; SECTORS];
        let counts_for = |cell: &Cell| -> (bool, bool) {
            let leaves = corridor.leaves(scene.config, cell.slope);
            let stays = leaves <= corridor.clear;
            // A steeper ray counts where it ends before it leaves the corridor, and tells nothing beyond.
            let inside = leaves.is_finite() && cell.closing > leaves + cell.sd.max(0.05 * leaves);
            (stays, cell.known && (stays || inside))
        };
        for cell in cells.iter().filter(|cell| cell.shown) {
            let (stays, counts_too) = counts_for(cell);
            self.shown[cell.sector] += u32::from(stays);
            self.seen[cell.sector] += u32::from(stays && counts_too);
            counts[cell.sector] += usize::from(counts_too);
        }
        let mut next = [0; SECTORS];
        for k in 0..SECTORS {
            next[k] = self.starts[k];
            self.starts[k + 1] = self.starts[k] + counts[k];
        }
        self.members.clear();
        self.members.reserve(cells.len());
        self.members.resize(self.starts[SECTORS], 0);
        for (i, cell) in (0u32..).zip(cells).filter(|(_, cell)| cell.shown && counts_for(cell).1) {
            self.members[next[cell.sector]] = i;
            next[cell.sector] += 1;
        }
    }

    fn members(&self, sector: usize) -> std::ops::Range<usize> {
        self.starts[sector]..self.starts[sector + 1]
    }

    /// The nearest surface that enough cells of `sector` ± `wide` make.
    fn estimate(&mut self, cells: &[Cell], scene: &Scene<'_>, sector: usize, wide: usize) -> Option<Estimate> {
        let config = scene.config;
        let shared = config.shared_px * scene.pixel;
        self.order.clear();
        for k in 0..=2 * wide {
            let near = (sector + SECTORS + k - wide) % SECTORS;
            self.order.extend_from_slice(&self.members[self.members(near)]);
        }
        let all = self.order.len();
        let needed = config.cells_min.max((config.cells_part_min * all as f64).ceil() as usize);
        if all < needed {
            return None;
        }
        surface::nearest(&mut self.order, cells, shared, needed)?;
        let cell = |i: &u32| &cells[*i as usize];
        let sd = |cell: &Cell| surface::sd(cell, shared);
        let (count, mut weights, mut stretch) = (self.order.len(), 0.0, 0.0);
        let mut sum = 0.0;
        let (mut by_shift, mut by_heading) = (Vector2::zeros(), Vector2::zeros());
        for i in &self.order {
            let weight = 1.0 / sd(cell(i)).powi(2);
            weights += weight;
            sum += weight * cell(i).closing;
            stretch += weight * cell(i).stretch;
            by_shift += cell(i).by_shift * weight;
            by_heading += cell(i).by_heading * weight;
        }
        let closing = sum / weights;
        (by_shift, by_heading) = (by_shift / weights, by_heading / weights);
        let heading = by_heading.dot(&(scene.heading.covariance * by_heading));
        let independent = (count as f64 / config.likeness_cells).max(1.0) / count as f64;
        let variance = 1.0 / (weights * independent) + heading + (shared * by_shift.norm()).powi(2);
        let part = |near: usize| {
            let members = &self.members[self.members(near)];
            members.iter().filter(|i| surface::holds(cell(i), closing, shared)).count() as f64 / members.len() as f64
        };
        // NaN where a sector shows nothing.
        let filled =
            wide == 0 || (0..=2 * wide).all(|k| part((sector + SECTORS + k - wide) % SECTORS) >= WIDE_PART_MIN);
        Some(Estimate { closing, variance, filled, stretch: stretch / weights })
    }

    /// Takes a step's cells into the tracks.
    pub(super) fn update(&mut self, cells: &[Cell], scene: &Scene<'_>, corridor: &Corridor) {
        self.gather(cells, scene, corridor);
        let config = scene.config;
        let sure = (SURE_PART * corridor.clear).powi(2);
        for sector in 0..SECTORS {
            let mut found = self.estimate(cells, scene, sector, 0);
            for wide in 1..=2 {
                if found.is_some_and(|found| found.variance <= sure) || self.members(sector).is_empty() {
                    break;
                }
                // Around the focus nothing moves: what stands there shows beside it, where it is one large surface.
                let wider = self.estimate(cells, scene, sector, wide).filter(|wider| {
                    wider.filled
                        && wider.closing > corridor.clear
                        && found.is_none_or(|found| wider.variance < found.variance)
                });
                found = wider.or(found);
            }
            let Some(found) = found else { continue };
            let whole = f64::from(self.seen[sector]) >= config.seen_part_min * f64::from(self.shown[sector])
                && self.shown[sector] > 0;
            let track = &mut self.tracks[sector];
            if track.alive {
                // First order in time, weighted by what each is worth.
                let fresh = 1.0 - (-scene.interval_s / config.delay_s).exp();
                let (kept, new) = ((1.0 - fresh) / track.variance, fresh / found.variance);
                let part = new / (kept + new);
                track.closing += part * (found.closing - track.closing);
                track.variance = (1.0 - part) * track.variance + part * found.variance;
                track.stretch += part * (found.stretch - track.stretch);
            } else {
                (track.closing, track.variance, track.stretch) = (found.closing, found.variance, found.stretch);
            }
            (track.age_s, track.alive, track.whole) = (0.0, true, whole);
        }
    }

    /// What is known of each sector now.
    pub(super) fn conclude(&self, config: &Config, corridor: &Corridor) -> [Sector; SECTORS] {
        self.tracks.map(|track| {
            if !track.alive {
                return Sector::Unknown;
            }
            let sure = track.variance <= corridor.clear.powi(2);
            let occupied = super::below((track.closing - corridor.clear) / track.variance.sqrt().max(1e-9));
            let ttc_s = 1.0 / track.closing;
            if track.closing > 0.0 && occupied >= config.confidence_min {
                let distance_m = corridor.speed.map_or(f64::NAN, |speed| speed * ttc_s * track.stretch);
                return Sector::Occupied { ttc_s, distance_m, confidence: occupied, whole: track.whole };
            }
            match 1.0 - occupied {
                free if free >= config.confidence_min && sure && track.whole => Sector::Free { confidence: free },
                _ => Sector::Unknown,
            }
        })
    }
}
