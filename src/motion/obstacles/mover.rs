//! What moves by itself: connected cells whose vectors leave the lines through the focus of expansion.
//!
//! Their distance is not known, but how fast they grow is: the divergence of their own flow is twice the inverse of the
//! time to contact, whoever of the two moves.

use nalgebra::{Matrix3, Vector3};

use super::cell::{Cell, Scene};

/// A vector that comes towards the focus by more than this part of its own kind's noise can't be of what stands still.
const OFF: u8 = 1;
const TAKEN: u8 = 2;

/// Scratch memory.
#[derive(Debug, Default)]
pub(super) struct Movers {
    marks: Vec<u8>,
    cluster: Vec<u32>,
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
        for start in 0..cells.len() {
            if self.marks[start] != OFF {
                continue;
            }
            self.flood(start, columns);
            if self.cluster.len() >= config.mover_cells_min {
                self.grow(cells, scene);
            } else {
                // Single wild vectors are of nothing.
                self.cluster.iter().for_each(|i| cells[*i as usize].known = false);
            }
        }
    }

    /// The marked cells that hang together with `start`.
    fn flood(&mut self, start: usize, columns: usize) {
        self.cluster.clear();
        self.cluster.push(start as u32);
        self.marks[start] = TAKEN;
        let mut next = 0;
        while let Some(at) = self.cluster.get(next).map(|i| *i as usize) {
            next += 1;
            let column = at % columns;
            let beside = [
                (column > 0).then(|| at.wrapping_sub(1)),
                (column + 1 < columns).then_some(at + 1),
                at.checked_sub(columns),
                Some(at + columns),
            ];
            for near in beside.into_iter().flatten() {
                if self.marks.get(near) == Some(&OFF) {
                    self.marks[near] = TAKEN;
                    self.cluster.push(near as u32);
                }
            }
        }
    }

    /// Fits an affine flow to the cluster; half its divergence is the inverse time to contact.
    fn grow(&self, cells: &mut [Cell], scene: &Scene<'_>) {
        let members = || self.cluster.iter().map(|i| *i as usize);
        let count = self.cluster.len() as f64;
        let mut middle = [0.0; 2];
        for i in members() {
            middle = std::array::from_fn(|k| middle[k] + cells[i].older[k] / count);
        }
        let place = |cell: &Cell| Vector3::new(cell.older[0] - middle[0], cell.older[1] - middle[1], 1.0);
        let (mut normal, mut right) = (Matrix3::zeros(), [Vector3::zeros(); 2]);
        for i in members() {
            let (at, shift) = (place(&cells[i]), cells[i].shift());
            normal += at * at.transpose() * cells[i].weight;
            right[0] += at * (shift.x * cells[i].weight);
            right[1] += at * (shift.y * cells[i].weight);
        }
        let fit = normal.try_inverse().map(|inverse| (inverse, inverse * right[0], inverse * right[1]));
        let Some((inverse, u, v)) = fit else {
            members().for_each(|i| cells[i].known = false);
            return;
        };
        let mut noise = 0.0;
        for i in members() {
            let (at, shift) = (place(&cells[i]), cells[i].shift());
            let off = [shift.x - u.dot(&at), shift.y - v.dot(&at)];
            noise += cells[i].weight * (off[0] * off[0] + off[1] * off[1]);
        }
        let independent = (count / scene.config.likeness_cells).max(1.0);
        let variance = (noise / (2.0 * count)).max(scene.heading.spread.powi(2)) * (count / independent);
        let growth = 0.5 * (u.x + v.y);
        let sd = 0.5 * (variance * (inverse[(0, 0)] + inverse[(1, 1)])).sqrt();
        // At the newer frame it is nearer by what it came.
        let closing = growth / (1.0 + growth).max(0.1) / scene.interval_s;
        for i in members() {
            let cell = &mut cells[i];
            cell.moving = true;
            cell.closing = closing;
            // The cluster is one measurement: the sector's estimate divides by its cells again.
            cell.sd = sd * independent.sqrt() / scene.interval_s;
            cell.by_shift.fill(0.0);
            cell.by_heading.fill(0.0);
        }
    }
}
