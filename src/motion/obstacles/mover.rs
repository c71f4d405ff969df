//! What moves by itself: cells whose vectors leave the lines through the focus of expansion, and what hangs together with
//! them.
//!
//! Their distance is not known, but how fast they grow is: the divergence of their own flow is twice the inverse of the
//! time to contact, whoever of the two moves. What is on a course of collision keeps its bearing: its middle does not move
//! at all and looks like something far away. So the cells between those that betray it are its own where they fit its
//! affine flow.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::cell::{Cell, Scene, hypot};

/// Leaves its line, or goes back on it.
const OFF: u8 = 1;
const TAKEN: u8 = 2;
/// Clusters that are held apart; of more only the first are looked at.
const CLUSTERS_MAX: usize = 16;
/// A cell fits the flow of a cluster within so many deviations.
const FIT_SDS: f64 = 3.0;

/// Columns and rows, first and last.
type Box2 = [[usize; 2]; 2];

/// Connected cells, or several such that move as one.
#[derive(Debug, Clone, Copy)]
struct Cluster {
    bounds: Box2,
    cells: usize,
    flow: Affine,
}

/// u and v as linear functions of the place around a middle.
#[derive(Debug, Clone, Copy)]
struct Affine {
    middle: [f64; 2],
    u: Vector3<f64>,
    v: Vector3<f64>,
    inverse: Matrix3<f64>,
    /// Mean squared residual of a component, rad².
    noise: f64,
}

/// Scratch memory.
#[derive(Debug, Default)]
pub(super) struct Movers {
    /// 0, `OFF`, and from `TAKEN` on the cluster that the cell belongs to.
    marks: Vec<u8>,
    stack: Vec<u32>,
    clusters: Vec<Cluster>,
}

impl Movers {
    /// Marks the cells of what moves, and gives them the time to contact of their cluster.
    pub(super) fn find(&mut self, cells: &mut [Cell], columns: usize, scene: &Scene<'_>) {
        let config = scene.config;
        self.marks.clear();
        self.marks.extend(cells.iter().map(|cell| {
            let across = cell.off_sds > config.mover_sds && cell.off.abs() > config.mover_px_min * scene.pixel;
            let back = cell.along_sds < -config.mover_sds
                && cell.shift().norm() > (config.mover_px_min + config.shared_px) * scene.pixel;
            u8::from(cell.known && (across || back)) * OFF
        }));
        self.clusters.clear();
        for start in 0..cells.len() {
            if self.marks[start] == OFF {
                self.flood(start, cells, columns, config.mover_cells_min);
            }
        }
        self.join(cells, columns, scene);
        for index in 0..self.clusters.len() {
            self.grow(index, cells, columns, scene);
        }
    }

    /// The marked cells that hang together with `start`; too few of them are of nothing.
    fn flood(&mut self, start: usize, cells: &mut [Cell], columns: usize, least: usize) {
        let name = TAKEN + self.clusters.len() as u8;
        let [row, column] = [start / columns, start % columns];
        let mut bounds = [[column; 2], [row; 2]];
        self.stack.clear();
        self.stack.push(start as u32);
        self.marks[start] = name;
        let mut next = 0;
        while let Some(at) = self.stack.get(next).map(|i| *i as usize) {
            next += 1;
            for (bound, place) in bounds.iter_mut().zip([at % columns, at / columns]) {
                *bound = [bound[0].min(place), bound[1].max(place)];
            }
            let column = at % columns;
            let beside = [
                (column > 0).then(|| at.wrapping_sub(1)),
                (column + 1 < columns).then_some(at + 1),
                at.checked_sub(columns),
                Some(at + columns),
            ];
            for near in beside.into_iter().flatten() {
                if self.marks.get(near) == Some(&OFF) {
                    self.marks[near] = name;
                    self.stack.push(near as u32);
                }
            }
        }
        let fitted = match self.stack.len() >= least && self.clusters.len() < CLUSTERS_MAX {
            true => Affine::fit(self.stack.iter().map(|i| &cells[*i as usize])),
            false => None,
        };
        match fitted {
            Some(flow) => self.clusters.push(Cluster { bounds, cells: self.stack.len(), flow }),
            None => {
                for i in &self.stack {
                    cells[*i as usize].known = false;
                    self.marks[*i as usize] = 0;
                }
            }
        }
    }

    /// Clusters above or below each other that move as one become one: the middle of a thing may not betray it.
    fn join(&mut self, cells: &[Cell], columns: usize, scene: &Scene<'_>) {
        let mut one = 0;
        while one < self.clusters.len() {
            let joined = (one + 1..self.clusters.len()).find(|other| {
                let (a, b) = (&self.clusters[one], &self.clusters[*other]);
                let over = |i: usize| {
                    let [low, high] = [a.bounds[i][0].max(b.bounds[i][0]), a.bounds[i][1].min(b.bounds[i][1])];
                    let wide = |c: &Cluster| c.bounds[i][1] - c.bounds[i][0] + 1;
                    high >= low && 2 * (high - low + 1) >= wide(a).min(wide(b))
                };
                let limit = scene.config.mover_px_min * scene.pixel;
                let off = |from: &Cluster, to: &Cluster| {
                    let there = Vector2::new(to.flow.u[2], to.flow.v[2]);
                    (from.flow.at(to.flow.middle) - there).norm() <= limit + FIT_SDS * from.flow.sd(to.flow.middle)
                };
                over(0) && off(a, b) && off(b, a)
            });
            let Some(other) = joined else {
                one += 1;
                continue;
            };
            let gone = self.clusters.remove(other);
            for mark in self.marks.iter_mut().filter(|mark| **mark >= TAKEN + other as u8) {
                *mark = if *mark == TAKEN + other as u8 { TAKEN + one as u8 } else { *mark - 1 };
            }
            let kept = &mut self.clusters[one];
            for (bound, more) in kept.bounds.iter_mut().zip(gone.bounds) {
                *bound = [bound[0].min(more[0]), bound[1].max(more[1])];
            }
            kept.cells += gone.cells;
            let marks = &self.marks;
            let members = within(kept.bounds, columns).filter(|i| marks[*i] == TAKEN + one as u8);
            if let Some(flow) = Affine::fit(members.map(|i| &cells[i])) {
                self.clusters[one].flow = flow;
            }
        }
    }

    /// Takes in what lies between a cluster's cells and moves as they do, and times all of them by their divergence.
    fn grow(&mut self, index: usize, cells: &mut [Cell], columns: usize, scene: &Scene<'_>) {
        let (cluster, name) = (self.clusters[index], TAKEN + index as u8);
        for i in within(cluster.bounds, columns) {
            let cell = &cells[i];
            let limit = FIT_SDS * hypot(scene.heading.spread / cell.weight.sqrt(), cluster.flow.sd(cell.older));
            if cell.seen && self.marks[i] == 0 && (cluster.flow.at(cell.older) - cell.shift()).norm() <= limit {
                self.marks[i] = name;
            }
        }
        let marks = &self.marks;
        let members = || within(cluster.bounds, columns).filter(|i| marks[*i] == name);
        let Some(flow) = Affine::fit(members().map(|i| &cells[i])) else { return };
        let count = members().count() as f64;
        let independent = (count / scene.config.likeness_cells).max(1.0);
        let variance = flow.noise.max(scene.heading.spread.powi(2)) * (count / independent);
        let growth = 0.5 * (flow.u[0] + flow.v[1]);
        let sd = 0.5 * (variance * (flow.inverse[(0, 0)] + flow.inverse[(1, 1)])).sqrt();
        // At the newer frame it is nearer by what it came.
        let closing = growth / (1.0 + growth).max(0.1) / scene.interval_s;
        for i in members() {
            let cell = &mut cells[i];
            (cell.moving, cell.known, cell.closing) = (true, true, closing);
            // The cluster is one measurement: the sector's estimate divides by its cells again.
            cell.sd = sd * independent.sqrt() / scene.interval_s;
            cell.by_shift.fill(0.0);
            cell.by_heading.fill(0.0);
        }
    }
}

impl Affine {
    /// Weighted least squares; none where the cells lie on a line.
    fn fit<'a>(members: impl Iterator<Item = &'a Cell> + Clone) -> Option<Affine> {
        let (mut weights, mut middle) = (0.0, [0.0; 2]);
        for cell in members.clone() {
            weights += cell.weight;
            middle = std::array::from_fn(|k| middle[k] + cell.weight * cell.older[k]);
        }
        let middle = middle.map(|sum| sum / weights);
        let place = |cell: &Cell| Vector3::new(cell.older[0] - middle[0], cell.older[1] - middle[1], 1.0);
        let (mut normal, mut right) = (Matrix3::zeros(), [Vector3::zeros(); 2]);
        for cell in members.clone() {
            let (at, shift) = (place(cell), cell.shift());
            normal += at * at.transpose() * cell.weight;
            right[0] += at * (shift.x * cell.weight);
            right[1] += at * (shift.y * cell.weight);
        }
        let inverse = normal.try_inverse()?;
        let (u, v) = (inverse * right[0], inverse * right[1]);
        let (mut noise, mut count) = (0.0, 0.0);
        for cell in members {
            let (at, shift) = (place(cell), cell.shift());
            noise += cell.weight * ((shift.x - u.dot(&at)).powi(2) + (shift.y - v.dot(&at)).powi(2));
            count += 2.0;
        }
        Some(Affine { middle, u, v, inverse, noise: noise / count })
    }

    fn row(&self, place: [f64; 2]) -> Vector3<f64> {
        Vector3::new(place[0] - self.middle[0], place[1] - self.middle[1], 1.0)
    }

    /// The flow at a place.
    fn at(&self, place: [f64; 2]) -> Vector2<f64> {
        let row = self.row(place);
        Vector2::new(self.u.dot(&row), self.v.dot(&row))
    }

    /// How far a component of that may be off.
    fn sd(&self, place: [f64; 2]) -> f64 {
        let row = self.row(place);
        (self.noise * row.dot(&(self.inverse * row))).max(0.0).sqrt()
    }
}

/// The cells of a part of the raster.
fn within([x, y]: Box2, columns: usize) -> impl Iterator<Item = usize> + Clone {
    (y[0]..=y[1]).flat_map(move |row| (x[0]..=x[1]).map(move |column| row * columns + column))
}
