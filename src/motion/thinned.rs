//! The raster of a flow as motion looks at it: thinned evenly, with the rays of its cells and what a vector there weighs.

use nalgebra::{Matrix2, Vector2};

use super::lens::Lens;
use crate::flow::{Flow, Grid};

/// A raster of which one cell of `step` along rows and columns is looked at, in the middle of those that it stands for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Thinned {
    grid: Grid,
    pub(super) step: usize,
}

impl Thinned {
    /// Every cell.
    pub(super) fn whole(grid: Grid) -> Self {
        Self { grid, step: 1 }
    }

    /// At most so many cells.
    pub(super) fn to(grid: Grid, most: usize) -> Self {
        let mut step = 1;
        while grid.width.div_ceil(step) * grid.height.div_ceil(step) > most {
            step += 1;
        }
        Self { grid, step }
    }

    /// The places of some of so many along a side.
    fn along(self, count: usize) -> impl Iterator<Item = usize> {
        let first = self.step / 2;
        (first..count.max(first + 1)).step_by(self.step)
    }

    /// How many columns are looked at.
    pub(super) fn columns(self) -> usize {
        self.along(self.grid.width).count()
    }

    /// (column, row) of those that are, row by row.
    pub(super) fn cells(self) -> impl Iterator<Item = (usize, usize)> {
        self.along(self.grid.height).flat_map(move |row| self.along(self.grid.width).map(move |column| (column, row)))
    }

    /// A cell's pixel of the frame.
    pub(super) fn pixel(self, (column, row): (usize, usize)) -> [f64; 2] {
        let middle = |i: usize, scale: f32| (i as f64 + 0.5) * f64::from(scale) - 0.5;
        [middle(column, self.grid.scale[0]), middle(row, self.grid.scale[1])]
    }

    /// A cell's vector, where it is a number, and its confidence.
    pub(super) fn seen(self, flow: &Flow<'_>, (column, row): (usize, usize)) -> Option<([f64; 2], f64)> {
        let cell = row * self.grid.width + column;
        let confidence = f64::from(*flow.confidence.get(cell)?);
        let [u, v] = *flow.vectors.get(2 * cell..2 * cell + 2)? else { return None };
        (u.is_finite() && v.is_finite()).then_some(([u, v].map(f64::from), confidence))
    }
}

/// What a vector weighs by its confidence: a probability p of being right to within a pixel is a Gaussian of variance
/// −1 / (2 ln(1 − p)) px².
pub(super) fn weight(confidence: f64) -> f64 {
    -2.0 * (1.0 - confidence.min(0.999)).ln()
}

/// A cell's ray (x, y, 1), and by how many pixels the image moves with it, where the lens has rays around it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub(super) at: [f64; 2],
    pub(super) pixels: Option<Matrix2<f64>>,
}

/// Rays of a raster's cells, which change with raster and calibration only.
#[derive(Debug, Default)]
pub(super) struct Rays {
    pub(super) rays: Vec<Option<Ray>>,
    of: Option<(Thinned, Lens)>,
}

impl Rays {
    /// Sees to it that they are those of this raster.
    pub(super) fn see(&mut self, lens: &Lens, raster: Thinned) {
        if self.of.as_ref().is_some_and(|(of, by)| *of == raster && by == lens) {
            return;
        }
        self.of = Some((raster, lens.clone()));
        self.rays.clear();
        self.rays.extend(raster.cells().map(|cell| {
            let pixel = raster.pixel(cell);
            lens.ray(pixel).map(|at| Ray { at, pixels: moving(lens, pixel) })
        }));
    }
}

fn moving(lens: &Lens, [x, y]: [f64; 2]) -> Option<Matrix2<f64>> {
    let ray = |x, y| lens.ray([x, y]).map(Vector2::from);
    let (across, down) = (ray(x + 0.5, y)? - ray(x - 0.5, y)?, ray(x, y + 0.5)? - ray(x, y - 0.5)?);
    Matrix2::from_columns(&[across, down]).try_inverse()
}
