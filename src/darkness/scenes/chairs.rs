//! Scenes as FlyingChairs has them: a photograph that moves, and things that fly before it.
//!
//! Motion is drawn by the law of Dosovitskiy et al. 2015: with probability p a figure is
//! clamp(µ + sign(γ)·|γ|^k, a, b) of γ ~ N(0, σ), else it is µ. A thing's motion is its own, about its middle, on top of the
//! background's. The form and its figures were not at hand to be checked against the paper's text; over 100 pairs they
//! give a mean of 14.3 px and a median of 7.1, where five public pairs of FlyingChairs have 9.3 and 4.7. What is added to theirs: a mild perspective, holes, thin things, and repeated textures.

use std::f64::consts::TAU;

use super::{
    library::Library,
    maps::{Dice, Map, about, apply, inverse, shift, turn},
    render::Layer,
    shapes::Outline,
};

/// µ, σ, k, a, b, p.
struct Law(f64, f64, f64, f64, f64, f64);

/// Pixels, degrees, and a factor.
struct Motion {
    shift: Law,
    turn: Law,
    zoom: Law,
    /// Deviation of the perspective, per frame width.
    tilt: f64,
}

const BACKGROUND: Motion = Motion {
    shift: Law(0.0, 1.3, 4.0, -40.0, 40.0, 1.0),
    turn: Law(0.0, 1.3, 2.0, -10.0, 10.0, 0.3),
    zoom: Law(1.0, 0.1, 2.0, 0.93, 1.07, 0.6),
    tilt: 0.015,
};

const THING: Motion = Motion {
    shift: Law(0.0, 2.3, 3.0, -120.0, 120.0, 1.0),
    turn: Law(0.0, 2.3, 2.0, -30.0, 30.0, 0.7),
    zoom: Law(1.0, 0.18, 2.0, 0.8, 1.2, 0.7),
    tilt: 0.05,
};

/// How often a motion is seen in perspective.
const TILTED: f64 = 0.35;
/// Half of a thing's size: mean, deviation, least and most, as parts of the square root of the frame's area.
const RADIUS: [f64; 4] = [0.07, 0.07, 0.035, 0.4];
/// What reaches farther than this part of the frame's width turns and grows the less for it.
const CALM: f64 = 0.28;

impl Law {
    fn draw(&self, dice: &mut Dice) -> f64 {
        let Law(mean, deviation, power, low, high, part) = *self;
        if !dice.chance(part) {
            return mean;
        }
        let drawn = deviation * dice.normal();
        (mean + drawn.signum() * drawn.abs().powf(power)).clamp(low, high)
    }
}

impl Motion {
    /// About `centre`, in a frame of this width; of turn, zoom and perspective only the part `ease`.
    fn draw(&self, dice: &mut Dice, centre: [f64; 2], width: f64, ease: f64) -> Map {
        let by = [self.shift.draw(dice), self.shift.draw(dice)];
        let (angle, zoom) = (self.turn.draw(dice).to_radians(), self.zoom.draw(dice));
        let mut map = turn(ease * angle, 1.0 + ease * (zoom - 1.0));
        if dice.chance(TILTED) {
            map[(2, 0)] = ease * ease * self.tilt / width * dice.normal();
            map[(2, 1)] = ease * ease * self.tilt / width * dice.normal();
        }
        shift(by) * about(centre, map)
    }
}

/// The layers of a scene, back to front.
pub(super) fn layers<'l>(dice: &mut Dice, library: &'l Library, size: [usize; 2]) -> Vec<Layer<'l>> {
    let [width, height] = size.map(|side| side as f64);
    let middle = [(width - 1.0) / 2.0, (height - 1.0) / 2.0];
    let camera = BACKGROUND.draw(dice, middle, width, 1.0);
    let reach = 0.5 * width.max(height);
    let mut layers = vec![Layer {
        motion: camera,
        local: shift(middle.map(|side| -side)),
        outline: Outline::All,
        fill: library.window(dice, reach, [0.65, 1.5], 0.25),
    }];
    let things = 5 + dice.pick(10);
    for _ in 0..things {
        let centre = [dice.even(-0.02, 1.02) * width, dice.even(-0.02, 1.02) * height];
        let side = (width * height).sqrt();
        let radius = (RADIUS[0] + RADIUS[1] * dice.normal()).clamp(RADIUS[2], RADIUS[3]) * side;
        let mut layer = thing(dice, library, centre, radius, width);
        let ease = (CALM * width / f64::from(layer.outline.reach())).min(1.0);
        layer.motion = camera * THING.draw(dice, centre, width, ease);
        layers.push(layer);
    }
    layers
}

/// The kinds of things that fly.
#[derive(Clone, Copy)]
enum Kind {
    Cutout,
    Blob,
    Polygon,
    Ring,
    Lines,
    Lattice,
}

/// Something of about this radius, at `centre` in frame 1, that does not move yet.
pub(super) fn thing<'l>(dice: &mut Dice, library: &'l Library, centre: [f64; 2], radius: f64, width: f64) -> Layer<'l> {
    let motion = Map::identity();
    let cutouts = if library.cutouts.is_empty() { 0.0 } else { 0.55 };
    let kinds = [
        (cutouts, Kind::Cutout),
        (0.16, Kind::Blob),
        (0.13, Kind::Polygon),
        (0.11, Kind::Ring),
        (0.08, Kind::Lines),
        (0.08, Kind::Lattice),
    ];
    let angle = dice.even(0.0, TAU);
    let kind = dice.weighted(&kinds).unwrap_or(Kind::Blob);
    if let (Kind::Cutout, Some(fill)) = (kind, library.cutout(dice, radius)) {
        // Most things stand upright.
        let angle = if dice.chance(0.3) { angle } else { 0.2 * dice.normal() };
        let local = turn(-angle, 1.0) * shift(centre.map(|at| -at));
        return Layer { motion, local, outline: Outline::Cutout(radius as f32), fill };
    }
    let outline = match kind {
        Kind::Cutout | Kind::Blob => Outline::blob(dice, radius),
        Kind::Polygon => Outline::polygon(dice, radius),
        Kind::Ring => Outline::ring(dice, radius),
        Kind::Lines => {
            let length = dice.ratio(2.0 * radius, 2.5 * width.max(2.0 * radius));
            Outline::lines(dice, length)
        }
        Kind::Lattice => Outline::lattice(dice, radius),
    };
    let fill = if dice.chance(0.15) { library.repeated(dice) } else { library.window(dice, radius, [0.6, 2.0], 0.6) };
    Layer { motion, local: turn(-angle, 1.0) * shift(centre.map(|at| -at)), outline, fill }
}

/// The longest way of a layer's middle and of the corners of what it covers in the frame.
pub(super) fn farthest(layer: &Layer<'_>, [width, height]: [usize; 2]) -> f64 {
    let corner = [(width - 1) as f64, (height - 1) as f64];
    let reach = f64::from(layer.outline.reach());
    let back = inverse(&layer.local);
    let points: Vec<[f64; 2]> = if reach.is_finite() {
        let square = [[0.0, 0.0], [-reach, -reach], [reach, -reach], [reach, reach], [-reach, reach]];
        square.into_iter().filter_map(|point| apply(&back, point)).collect()
    } else {
        vec![[0.0, 0.0], [corner[0], 0.0], corner, [0.0, corner[1]]]
    };
    let way = |point: [f64; 2]| {
        let from: [f64; 2] = std::array::from_fn(|axis| point[axis].clamp(0.0, corner[axis]));
        apply(&layer.motion, from).map_or(f64::INFINITY, |to| (to[0] - from[0]).hypot(to[1] - from[1]))
    };
    points.into_iter().map(way).fold(0.0, f64::max)
}
