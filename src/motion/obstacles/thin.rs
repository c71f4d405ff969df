//! How far away long thin things are, and poles by their edges: the parallax of a line over seconds, where its parts show no
//! motion along it.
//!
//! Through the camera and a line runs a plane. With t the direction of the path and e the direction across both path and
//! line, the plane seen from the place (a, b) along t and e has the slope y = (h − b) / (d − a) against t, where the line
//! passes d ahead and h aside of the newest place. Over the places of the last two seconds that gives 1 / d; beside it
//! stand what the path's direction may be off by, which makes c · a of b, and what the gyro's bias turns. For every inverse
//! time to contact of a grid the rest is linear, so that what is believed of it needs no start. All of a line is told with
//! that time: it is taken as lying across the path.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Matrix3, Unit, Vector3};

use super::{
    Config, SECTORS, Sector,
    cell::{self, Cell},
    ridge::{Ridge, Ridges},
    sector::Corridor,
};
use crate::{
    clock::Stamp,
    exposure::Exposed,
    motion::{lens::Lens, quality::below},
};

/// How far back is looked, and how far apart what is kept of it must be.
const HISTORY_S: f64 = 2.0;
const SPACING_S: f64 = 0.06;
/// A line is lost once it was not seen for so long.
const UNSEEN_S: f64 = 0.25;
/// The fewest views of one thing; one view may be a chance in the noise.
const SEEN_MIN: usize = 2;
/// The fewest views that make a distance.
const VIEWS_MIN: usize = 6;
/// Two lines are one thing where their planes are within this, in developed pixels.
const SAME_PX: f64 = 3.0;
/// How well a line's plane is seen, in developed pixels; steps err alike.
const PLANE_SD_PX: f64 = 0.2;
/// A thing that stands still leaves no more than this many deviations, root mean square.
const LEFT_SDS_MAX: f64 = 3.0;
/// A time to contact is told where it is known to within this part.
const SD_PART_MAX: f64 = 0.3;
/// Inverse times to contact that are tried, 1/s.
const TRIED: usize = 101;
const TRIED_MAX: f64 = 2.0;
/// Where it may be, a line is taken to go on beyond both its ends by this part of what is seen of it.
const BEYOND_PART: f64 = 0.5;
/// A cell of the flow holds what is within this many developed pixels of its middle.
const COVERED_PX: f64 = 6.0;
/// Things that are followed at a time.
const THINGS_MAX: usize = 16;
/// Places along a line at which its sectors are looked up.
const PLACES: usize = 192;

/// What a step knows of the camera's own motion; vectors in the optical axes of the older frame.
pub(super) struct Step {
    pub(super) older: Stamp,
    pub(super) newer: Stamp,
    /// Displacement to the newer frame: metres, or seconds of flight where speed is not known.
    pub(super) path: Vector3<f64>,
    /// Whether it is in metres.
    pub(super) metric: bool,
    pub(super) interval_s: f64,
    /// The older frame's axes to the newer one's.
    pub(super) turn: Matrix3<f64>,
    /// What the path's direction may be off by, radians, and what the gyro's bias may turn, rad/s.
    pub(super) heading_sd_rad: f64,
    pub(super) drift_sd_rad_s: f64,
    /// Radians a developed pixel.
    pub(super) pixel: f64,
}

/// A line as it was seen once.
#[derive(Debug, Clone, Copy)]
struct View {
    /// Unit normal of the plane through the camera and the line.
    normal: Vector3<f64>,
    /// Where the camera was, from where it is now.
    from: Vector3<f64>,
    age_s: f64,
}

/// A thing that is followed; vectors in the newest frame's optical axes.
#[derive(Debug, Clone, Default)]
struct Thing {
    bright: bool,
    /// It is the edge of something.
    edge: bool,
    views: Vec<View>,
    /// Unit rays of its ends.
    ends: [Vector3<f64>; 2],
    unseen_s: f64,
    /// Inverse time to contact and its deviation, 1/s; none where its planes do not say.
    closing: Option<[f64; 2]>,
}

/// Looks for lines and follows them. It allocates nothing once it has seen as many as it ever will.
#[derive(Debug, Default)]
pub(super) struct Things {
    ridges: Ridges,
    found: Vec<Ridge>,
    things: Vec<Thing>,
    spare: Vec<Thing>,
    /// The newest frame, and whether the places are in metres.
    newest: Option<(Stamp, bool)>,
}

impl Things {
    /// Takes in what the older frame of a step shows.
    pub(super) fn look(&mut self, older: &Exposed, lens: &Lens, step: &Step) {
        if self.newest != Some((step.older, step.metric)) {
            self.spare.append(&mut self.things);
        }
        self.newest = Some((step.newer, step.metric));
        let mut found = std::mem::take(&mut self.found);
        found.clear();
        self.ridges.find(older, lens, &mut found);
        for ridge in &found {
            self.assign(ridge, step);
        }
        self.found = found;
        for thing in &mut self.things {
            thing.closing = thing.measure(step);
        }
    }

    /// Cells that a line runs through or beside hold some of it and some of what is behind it, and the flow's mean of the two
    /// is of neither: where the line may be in the way, what such a cell says of something later isn't known.
    pub(super) fn cover(&self, cells: &mut [Cell], pixel: f64, config: &Config, corridor: &Corridor) {
        for thing in self.things.iter().filter(|thing| thing.views.len() >= SEEN_MIN) {
            let Some(View { normal, .. }) =
                thing.views.last().filter(|_| thing.near(corridor.clear) > 1.0 - config.confidence_min)
            else {
                continue;
            };
            let later = thing.closing.map_or(f64::INFINITY, |[closing, sd]| closing + 2.0 * sd);
            let middle = (thing.ends[0] + thing.ends[1]).normalize();
            let half = middle.dot(&thing.ends[0]).clamp(-1.0, 1.0).acos() * (1.0 + 2.0 * thing.beyond());
            let (reach, aside) = (half.min(FRAC_PI_2).cos(), COVERED_PX * pixel);
            for cell in cells.iter_mut().filter(|cell| cell.known && cell.closing < later) {
                let ray = Vector3::new(cell.older[0], cell.older[1], 1.0).normalize();
                cell.known &= ray.dot(normal).abs() > aside || ray.dot(&middle) < reach;
            }
        }
    }

    /// Goes on to the newer frame.
    pub(super) fn go_on(&mut self, step: &Step) {
        self.things.iter_mut().for_each(|thing| thing.go_on(step));
        let (things, spare) = (&mut self.things, &mut self.spare);
        spare.extend(things.extract_if(.., |thing| thing.unseen_s > UNSEEN_S));
    }

    /// A line belongs to the thing whose plane it continues, or to a new one.
    fn assign(&mut self, ridge: &Ridge, step: &Step) {
        let ends = ridge.ends.map(|[x, y]| Vector3::new(x, y, 1.0).normalize());
        let Some(normal) = ends[0].cross(&ends[1]).try_normalize(1e-6) else { return };
        let same = (SAME_PX * step.pixel).cos();
        let likeness = |thing: &Thing| thing.views.last().map_or(0.0, |view| view.normal.dot(&normal).abs());
        let open = self
            .things
            .iter()
            .enumerate()
            .filter(|(_, thing)| thing.unseen_s > 0.0 && (thing.bright, thing.edge) == (ridge.bright, ridge.edge));
        let best = open.map(|(i, thing)| (likeness(thing), i)).max_by(|a, b| a.0.total_cmp(&b.0));
        let at = match best.filter(|(likeness, _)| *likeness > same) {
            Some((_, at)) => at,
            None if self.things.len() >= THINGS_MAX => return,
            None => {
                let mut thing = self.spare.pop().unwrap_or_default();
                thing.views.clear();
                (thing.bright, thing.edge, thing.closing) = (ridge.bright, ridge.edge, None);
                self.things.push(thing);
                self.things.len() - 1
            }
        };
        self.things[at].see(normal, ends);
    }

    /// Puts what is known of thin things into the sectors: `level` brings the newer frame's optical axes to the sectors'
    /// frame, `path` is the motion's direction there.
    pub(super) fn tell(
        &self,
        sectors: &mut [Sector; SECTORS],
        level: &Matrix3<f64>,
        path: &Vector3<f64>,
        config: &Config,
        corridor: &Corridor,
    ) {
        for thing in self.things.iter().filter(|thing| thing.views.len() >= SEEN_MIN) {
            // By sector: what is met later than this is not in the way, and the ray's length over its part ahead, of that
            // place of the line which is the longest in the way.
            let mut shown = [None::<([f64; 2], bool)>; SECTORS];
            for place in 0..PLACES {
                let part = (place as f64 + 0.5) / PLACES as f64 * (1.0 + 2.0 * thing.beyond()) - thing.beyond();
                let seen = (0.0..1.0).contains(&part);
                let look = level * (thing.ends[0] * (1.0 - part) + thing.ends[1] * part);
                let (sector, slope, stretch) = cell::bearing(&look, path);
                let clear = corridor.leaves(config, slope).max(corridor.clear);
                let shown = &mut shown[sector];
                let longer = |([least, _], before): ([f64; 2], bool)| (seen, -clear) > (before, -least);
                if clear.is_finite() && shown.is_none_or(longer) {
                    *shown = Some(([clear, stretch], seen));
                }
            }
            for (sector, shown) in sectors.iter_mut().zip(shown) {
                match shown {
                    Some(([clear, stretch], true)) => {
                        thing.tell(sector, clear, corridor.speed.map(|speed| speed * stretch), config);
                    }
                    Some(([clear, _], false)) => thing.doubt(sector, clear, config),
                    None => {}
                }
            }
        }
    }
}

impl Thing {
    fn see(&mut self, normal: Vector3<f64>, ends: [Vector3<f64>; 2]) {
        let normal = match self.views.last() {
            Some(last) if last.normal.dot(&normal) < 0.0 => -normal,
            _ => normal,
        };
        // The newest view always counts; of those before it, some.
        let [newest, before] = [1, 2].map(|back| self.views.len().checked_sub(back).map(|at| self.views[at].age_s));
        if let (Some(newest), Some(before)) = (newest, before)
            && before - newest < SPACING_S
        {
            self.views.pop();
        }
        self.views.retain(|view| view.age_s <= HISTORY_S);
        self.views.push(View { normal, from: Vector3::zeros(), age_s: 0.0 });
        (self.ends, self.unseen_s) = (ends, 0.0);
    }

    /// Inverse time to contact at the older frame, and its deviation, by all views.
    fn measure(&self, step: &Step) -> Option<[f64; 2]> {
        let newest = self.views.last().filter(|_| self.views.len() >= VIEWS_MIN)?;
        let t = step.path.try_normalize(1e-9)?;
        let e = Unit::try_new(newest.normal - t * newest.normal.dot(&t), 0.1)?;
        let speed = step.path.norm() / step.interval_s;
        let sd = PLANE_SD_PX * step.pixel;
        let (mut chances, mut best) = ([0.0; TRIED], f64::INFINITY);
        let mut left = f64::INFINITY;
        for (i, chance) in chances.iter_mut().enumerate() {
            let inverse = TRIED_MAX * i as f64 / (TRIED - 1) as f64 / speed;
            let [cost, residual] = self.fit(inverse, [&t, &e], step, sd)?;
            *chance = cost;
            if cost < best {
                (best, left) = (cost, residual);
            }
        }
        if left > LEFT_SDS_MAX {
            return None;
        }
        let (mut sum, mut mean, mut square) = (0.0, 0.0, 0.0);
        for (i, cost) in chances.into_iter().enumerate() {
            let (closing, chance) = (TRIED_MAX * i as f64 / (TRIED - 1) as f64, (best - cost).exp());
            (sum, mean, square) = (sum + chance, mean + chance * closing, square + chance * closing * closing);
        }
        (mean, square) = (mean / sum, square / sum);
        // Values between those that are tried are as likely.
        let between = (TRIED_MAX / (TRIED - 1) as f64).powi(2) / 12.0;
        Some([mean, ((square - mean * mean).max(0.0) + between).sqrt()])
    }

    /// Minus the logarithm of how likely an inverse distance is, and the root mean square that is left, in deviations.
    fn fit(&self, inverse: f64, [t, e]: [&Vector3<f64>; 2], step: &Step, sd: f64) -> Option<[f64; 2]> {
        // Beforehand: any slope, the path's direction and the gyro's drift within what they may be off.
        let beforehand = [1.0, step.heading_sd_rad, step.drift_sd_rad_s].map(|sd| 1.0 / (sd * sd));
        let mut matrix = Matrix3::from_diagonal(&Vector3::from(beforehand));
        let (mut right, mut square) = (Vector3::zeros(), 0.0);
        let mut count = 0.0;
        for view in &self.views {
            let across = view.normal.dot(e);
            let (a, b) = (view.from.dot(t), view.from.dot(e));
            let reach = 1.0 - inverse * a;
            if across < 0.1 || reach < 0.05 {
                continue;
            }
            let slope = -view.normal.dot(t) / across + inverse * b / reach;
            let by = Vector3::new(1.0 / reach, inverse * a / reach, -view.age_s);
            matrix += by * by.transpose() / (sd * sd);
            right += by * (slope / (sd * sd));
            (square, count) = (square + slope * slope / (sd * sd), count + 1.0);
        }
        let solved = matrix.try_inverse()? * right;
        let cost = (square - solved.dot(&right)).max(0.0);
        Some([0.5 * (cost + matrix.determinant().ln()), (cost / f64::max(count, 1.0)).sqrt()])
    }

    /// The camera moves on to the newer frame.
    fn go_on(&mut self, step: &Step) {
        for view in &mut self.views {
            view.normal = step.turn * view.normal;
            view.from = step.turn * (view.from - step.path);
            view.age_s += step.interval_s;
        }
        self.ends = self.ends.map(|end| step.turn * end);
        self.unseen_s += step.interval_s;
        self.closing = self.closing.and_then(|[closing, sd]| {
            let left = 1.0 - closing * step.interval_s;
            (left > 0.2).then(|| [closing / left, sd / (left * left)])
        });
    }

    /// What it makes of a sector that shows it: what is met later than 1 / `clear` there is not in the way, and `speed` is
    /// how fast its rays shorten.
    fn tell(&self, sector: &mut Sector, clear: f64, speed: Option<f64>, config: &Config) {
        let near = self.near(clear);
        let Some(closing) = self.known().filter(|_| near >= config.confidence_min) else {
            return self.doubt(sector, clear, config);
        };
        // Either of the two is met, and what is met sooner stays.
        let sure = match *sector {
            Sector::Occupied { ttc_s, .. } if ttc_s * closing <= 1.0 => return,
            Sector::Occupied { confidence, .. } => confidence,
            _ => 0.0,
        };
        let distance_m = speed.map_or(f64::NAN, |speed| speed / closing);
        *sector = Sector::Occupied { ttc_s: 1.0 / closing, distance_m, confidence: near.max(sure), whole: false };
    }

    /// Inverse time to contact where it is known well enough to be told.
    fn known(&self) -> Option<f64> {
        self.closing.filter(|[closing, sd]| *sd <= SD_PART_MAX * closing).map(|[closing, _]| closing)
    }

    /// The probability that it is met before 1 / `clear`. Without a word on how near it is, a line may be anywhere; an edge is
    /// that of something which its own cells tell of.
    fn near(&self, clear: f64) -> f64 {
        match self.closing {
            Some([closing, sd]) if !self.edge || self.known().is_some() => below((closing - clear) / sd),
            _ => f64::from(u8::from(!self.edge)),
        }
    }

    /// How far it goes on beyond its ends, as a part of what is seen of it.
    fn beyond(&self) -> f64 {
        if self.edge { 0.0 } else { BEYOND_PART }
    }

    /// A sector that it may be in is not free, and what is told there is not the nearest for certain.
    fn doubt(&self, sector: &mut Sector, clear: f64, config: &Config) {
        let away = 1.0 - self.near(clear);
        match sector {
            Sector::Free { .. } if away < config.confidence_min => *sector = Sector::Unknown,
            Sector::Free { confidence } => *confidence = confidence.min(away),
            Sector::Occupied { whole, .. } => *whole &= away >= config.confidence_min,
            Sector::Unknown => {}
        }
    }
}
