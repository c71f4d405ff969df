//! Outlines of what flies: blobs, polygons, rings with holes, and thin things: poles, wires, grids.

use std::f64::consts::TAU;

use super::maps::Dice;

/// What a layer covers, in its own pixels around its middle.
#[derive(Debug, Clone)]
pub(super) enum Outline {
    /// Everything.
    All,
    /// What the texture's own transparency says; the reach from the middle.
    Cutout(f32),
    /// A signed distance on a grid, for closed outlines.
    Grid(Distances),
    /// Strokes with round ends.
    Strokes(Vec<Stroke>, f32),
}

/// Distance to the outline in pixels, positive inside; bilinear between the grid's points.
#[derive(Debug, Clone)]
pub(super) struct Distances {
    side: usize,
    reach: f32,
    values: Vec<f32>,
}

/// From one point to another, so thick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stroke {
    from: [f32; 2],
    to: [f32; 2],
    radius: f32,
}

impl Outline {
    /// Signed distance to the outline, positive inside; a lower bound of its size holds everywhere.
    #[inline(always)]
    pub fn distance(&self, x: f32, y: f32) -> f32 {
        match self {
            Outline::All => f32::INFINITY,
            // The texture's border is a square; its corners are the farthest.
            Outline::Cutout(reach) => reach - x.abs().max(y.abs()),
            Outline::Grid(grid) => grid.at(x, y),
            Outline::Strokes(strokes, _) => {
                strokes.iter().fold(f32::NEG_INFINITY, |best, stroke| best.max(stroke.distance(x, y)))
            }
        }
    }

    /// Nothing is covered farther from the middle than this, in either axis; infinite for all.
    pub fn reach(&self) -> f32 {
        match self {
            Outline::All => f32::INFINITY,
            Outline::Cutout(reach) | Outline::Strokes(_, reach) => *reach,
            Outline::Grid(grid) => grid.reach,
        }
    }

    /// A closed wavy line of about this radius, some of it stretched.
    pub fn blob(dice: &mut Dice, radius: f64) -> Outline {
        Outline::closed(&[wavy(dice, radius)])
    }

    /// Straight edges, some of them cut in deeply.
    pub fn polygon(dice: &mut Dice, radius: f64) -> Outline {
        let corners = 3 + dice.pick(7);
        let jag = dice.even(0.0, 0.5);
        let points = (0..corners).map(|i| {
            let angle = TAU * (i as f64 + dice.even(-0.3, 0.3)) / corners as f64;
            let length = radius * (1.0 - jag * dice.even(0.0, 1.0));
            [length * angle.cos(), length * angle.sin()]
        });
        Outline::closed(&[points.collect()])
    }

    /// A blob with one to three holes.
    pub fn ring(dice: &mut Dice, radius: f64) -> Outline {
        let mut contours = vec![wavy(dice, radius)];
        let holes = 1 + dice.pick(3);
        for hole in 0..holes {
            let (size, away) = if holes == 1 { (dice.even(0.35, 0.7), 0.0) } else { (dice.even(0.15, 0.3), 0.45) };
            let angle = TAU * (hole as f64 + dice.even(-0.1, 0.1)) / holes as f64;
            let middle = [away * radius * angle.cos(), away * radius * angle.sin()];
            let contour = wavy(dice, size * radius);
            contours.push(contour.into_iter().map(|[x, y]| [x + middle[0], y + middle[1]]).collect());
        }
        Outline::closed(&contours)
    }

    /// A few poles or sagging wires through the middle, so long that they may cross the whole frame.
    pub fn lines(dice: &mut Dice, length: f64) -> Outline {
        let mut strokes = Vec::new();
        let count = 1 + dice.pick(4);
        let (thick, gap, sag) = (dice.ratio(0.55, 4.0), dice.ratio(6.0, 40.0), dice.even(-0.12, 0.12) * length);
        let slope = dice.even(-0.05, 0.05);
        for line in 0..count {
            let offset = (line as f64 - (count - 1) as f64 / 2.0) * gap;
            let at = |part: f64| {
                let x = (part - 0.5) * length;
                [x, offset + slope * x * line as f64 + sag * (4.0 * part * (1.0 - part) - 0.5)]
            };
            let parts = if sag.abs() < 2.0 { 1 } else { 6 };
            for part in 0..parts {
                let [from, to] = [part, part + 1].map(|end| at(f64::from(end) / f64::from(parts)));
                strokes.push(Stroke::new(from, to, thick));
            }
        }
        Outline::strokes(strokes)
    }

    /// A lattice, as of fences, masts and windows: the same again and again.
    pub fn lattice(dice: &mut Dice, radius: f64) -> Outline {
        let (columns, rows) = (2 + dice.pick(5), 2 + dice.pick(4));
        let half = [radius, radius * dice.even(0.4, 1.0)];
        let thick = dice.ratio(0.8, 3.5);
        let mut strokes = Vec::new();
        for (axis, count) in [(0, columns), (1, rows)] {
            for line in 0..=count {
                let along = half[axis] * (2.0 * line as f64 / count as f64 - 1.0);
                let end = half[1 - axis];
                let [from, to] = [-end, end].map(|other| if axis == 0 { [along, other] } else { [other, along] });
                strokes.push(Stroke::new(from, to, thick));
            }
        }
        Outline::strokes(strokes)
    }

    /// A pole on its foot at the origin, upright (towards −y), with a crossbar now and then.
    pub fn pole(dice: &mut Dice, height: f64) -> Outline {
        let thick = dice.ratio(0.8, 5.0);
        let mut strokes = vec![Stroke::new([0.0, 0.0], [0.0, -height], thick)];
        for _ in 0..dice.pick(3) {
            let (at, wide) = (height * dice.even(0.5, 1.0), height * dice.even(0.1, 0.35));
            strokes.push(Stroke::new([-wide, -at], [wide, -at], thick * 0.6));
        }
        Outline::strokes(strokes)
    }

    fn strokes(strokes: Vec<Stroke>) -> Outline {
        let end = |stroke: &Stroke| {
            let far = |[x, y]: [f32; 2]| x.abs().max(y.abs());
            far(stroke.from).max(far(stroke.to)) + stroke.radius
        };
        let reach = strokes.iter().map(end).fold(1.0, f32::max) + 1.0;
        Outline::Strokes(strokes, reach)
    }

    /// What an odd number of closed lines surround.
    fn closed(contours: &[Vec<[f64; 2]>]) -> Outline {
        let far = contours.iter().flatten().fold(1.0_f64, |far, [x, y]| far.max(x.abs()).max(y.abs()));
        let reach = far as f32 + 2.0;
        let side = ((reach * 0.6) as usize).clamp(24, 80);
        let edges: Vec<[[f32; 2]; 2]> = contours
            .iter()
            .flat_map(|points| {
                let next = points.iter().cycle().skip(1);
                points.iter().zip(next).map(|(a, b)| [a.map(|v| v as f32), b.map(|v| v as f32)])
            })
            .collect();
        let place = |i: usize| (i as f32 / (side - 1) as f32 * 2.0 - 1.0) * reach;
        let values = (0..side * side).map(|i| signed([place(i % side), place(i / side)], &edges)).collect();
        Outline::Grid(Distances { side, reach, values })
    }
}

/// A wavy closed line of 40 points.
fn wavy(dice: &mut Dice, radius: f64) -> Vec<[f64; 2]> {
    const POINTS: usize = 40;
    let waves: [(f64, f64, f64); 3] =
        [0.35, 0.2, 0.12].map(|height| (2.0 + dice.pick(5) as f64, height * dice.even(0.0, 1.0), dice.even(0.0, TAU)));
    let stretch = if dice.chance(0.3) { dice.ratio(1.3, 3.0).sqrt() } else { dice.ratio(1.0, 1.3).sqrt() };
    let angles = (0..POINTS).map(|i| TAU * i as f64 / POINTS as f64);
    let point = |angle: f64| {
        let wave = |(count, height, phase): &(f64, f64, f64)| height * (count * angle + phase).cos();
        let length = radius * (1.0 + waves.iter().map(wave).sum::<f64>());
        [length * angle.cos() * stretch, length * angle.sin() / stretch]
    };
    angles.map(point).collect()
}

/// Distance to the nearest edge, positive where an odd number of edges lies to the right.
fn signed([x, y]: [f32; 2], edges: &[[[f32; 2]; 2]]) -> f32 {
    let (mut nearest, mut inside) = (f32::INFINITY, false);
    for [[ax, ay], [bx, by]] in edges {
        let (ex, ey, px, py) = (bx - ax, by - ay, x - ax, y - ay);
        let along = ((px * ex + py * ey) / (ex * ex + ey * ey).max(1e-12)).clamp(0.0, 1.0);
        let (dx, dy) = (px - along * ex, py - along * ey);
        nearest = nearest.min(dx * dx + dy * dy);
        inside ^= (*ay > y) != (*by > y) && px < ex * py / ey;
    }
    if inside { nearest.sqrt() } else { -nearest.sqrt() }
}

impl Distances {
    #[inline(always)]
    fn at(&self, x: f32, y: f32) -> f32 {
        let most = self.reach * 0.9999;
        let (inner_x, inner_y) = (x.clamp(-most, most), y.clamp(-most, most));
        let (over_x, over_y) = (x - inner_x, y - inner_y);
        let beyond = (over_x * over_x + over_y * over_y).sqrt();
        let scale = (self.side - 1) as f32 / (2.0 * self.reach);
        let (x, y) = ((inner_x + self.reach) * scale, (inner_y + self.reach) * scale);
        let (column, row) = ((x as usize).min(self.side - 2), (y as usize).min(self.side - 2));
        let (fx, fy) = (x - column as f32, y - row as f32);
        let at = row * self.side + column;
        let v = &self.values;
        let upper = v[at] + fx * (v[at + 1] - v[at]);
        let lower = v[at + self.side] + fx * (v[at + self.side + 1] - v[at + self.side]);
        upper + fy * (lower - upper) - beyond
    }
}

impl Stroke {
    fn new(from: [f64; 2], to: [f64; 2], radius: f64) -> Stroke {
        Stroke { from: from.map(|v| v as f32), to: to.map(|v| v as f32), radius: radius as f32 }
    }

    #[inline(always)]
    fn distance(&self, x: f32, y: f32) -> f32 {
        let [[ax, ay], [bx, by]] = [self.from, self.to];
        let (ex, ey, px, py) = (bx - ax, by - ay, x - ax, y - ay);
        let along = ((px * ex + py * ey) / (ex * ex + ey * ey).max(1e-12)).clamp(0.0, 1.0);
        let (dx, dy) = (px - along * ex, py - along * ey);
        self.radius - (dx * dx + dy * dy).sqrt()
    }
}
