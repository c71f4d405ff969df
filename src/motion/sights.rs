//! What the fit looks at: rays of both ends of the vectors, the turn taken off, of a thinned raster; and of every cell what the
//! frames' gradients say of its vector.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::{
    Odometer,
    fit::{Agreed, Fit, Found, Said, Sight},
    gyro::Turn,
    lens::Lens,
    odometer::Ground,
};
use crate::flow::{Flow, Gradients, Grid};

/// Rays of a raster's cells, row by row, which change with the calibration only.
#[derive(Debug, Default)]
pub(super) struct Rays {
    rays: Vec<Option<Ray>>,
    of: Option<(Grid, usize)>,
}

/// A cell's ray, and by how many pixels the image moves with it.
#[derive(Debug, Clone, Copy)]
struct Ray {
    at: [f64; 2],
    pixels: Matrix2<f64>,
}

/// The cells of a raster that are looked at: one of `step` along rows and columns, in the middle of those that it stands for.
fn cells(grid: Grid, step: usize) -> impl Iterator<Item = (usize, usize)> {
    let first = step / 2;
    let rows = (first..grid.height.max(first + 1)).step_by(step);
    rows.flat_map(move |row| (first..grid.width.max(first + 1)).step_by(step).map(move |column| (column, row)))
}

/// A cell's pixel of the frame.
fn pixel(grid: Grid, (column, row): (usize, usize)) -> [f64; 2] {
    let middle = |i: usize, scale: f32| (i as f64 + 0.5) * f64::from(scale) - 0.5;
    [middle(column, grid.scale[0]), middle(row, grid.scale[1])]
}

impl Rays {
    /// Those of every `step`th cell.
    fn see(&mut self, lens: &Lens, grid: Grid, step: usize) {
        if self.of.replace((grid, step)) == Some((grid, step)) {
            return;
        }
        let ray = |at| -> Option<Ray> {
            let [x, y] = pixel(grid, at);
            let apart = |a: Option<[f64; 2]>, b: Option<[f64; 2]>| Some(Vector2::from(a?) - Vector2::from(b?));
            let across = apart(lens.ray([x + 0.5, y]), lens.ray([x - 0.5, y]))?;
            let down = apart(lens.ray([x, y + 0.5]), lens.ray([x, y - 0.5]))?;
            Some(Ray { at: lens.ray([x, y])?, pixels: Matrix2::from_columns(&[across, down]).try_inverse()? })
        };
        self.rays.clear();
        self.rays.extend(cells(grid, step).map(ray));
    }
}

/// What a cell's sight is made of beside its own ray.
struct View<'a> {
    flow: &'a Flow<'a>,
    lens: &'a Lens,
    /// From the newer frame's axes to the older one's, optical.
    back: Matrix3<f64>,
    normal: Vector3<f64>,
    leans: Option<[Vector3<f64>; 2]>,
    confidence_min: f64,
    grazing_cosine_min: f64,
}

impl View<'_> {
    fn sight(&self, (column, row): (usize, usize), older: [f64; 2]) -> Option<Sight> {
        let Flow { grid, confidence, vectors, .. } = *self.flow;
        let cell = row * grid.width + column;
        let confidence = f64::from(*confidence.get(cell)?);
        let vector = vectors.get(2 * cell..2 * cell + 2)?;
        if confidence < self.confidence_min || confidence.is_nan() || !vector.iter().all(|v| v.is_finite()) {
            return None;
        }
        let [x, y] = pixel(grid, (column, row));
        let newer = self.lens.ray([x + f64::from(vector[0]), y + f64::from(vector[1])])?;
        let ray = Vector3::new(older[0], older[1], 1.0);
        let slope = self.normal.dot(&ray);
        let turned = self.back * Vector3::new(newer[0], newer[1], 1.0);
        if slope < self.grazing_cosine_min * ray.norm() || turned.z < 0.1 {
            return None;
        }
        // A probability p of being right to within a pixel is a Gaussian of variance −1 / (2 ln(1 − p)) px².
        let weight = -2.0 * (1.0 - confidence.min(0.999)).ln();
        let stretch = ((newer[0] - older[0]).powi(2) + (newer[1] - older[1]).powi(2)).sqrt();
        let newer = [turned.x / turned.z, turned.y / turned.z];
        let lean = self.leans.map_or([0.0; 2], |leans| leans.map(|lean| lean.dot(&ray)));
        Some(Sight { older, newer, slope, lean, weight, stretch, offered: true, ..Sight::default() })
    }
}

/// What a cell's gradients say, along its ray's x and y; `None` where that is nothing.
fn said(gradients: &Gradients<'_>, cell: usize, ray: &Ray) -> Option<Said> {
    let of = |plane: &[f32]| plane.get(cell).map(|value| f64::from(*value));
    let [xx, xy, yy] = gradients.information.map(of);
    let [right, down] = gradients.pull.map(of);
    let (xx, xy, yy) = (xx?, xy?, yy?);
    if xx <= 0.0 && yy <= 0.0 {
        return None;
    }
    let information = ray.pixels.transpose() * Matrix2::new(xx, xy, xy, yy) * ray.pixels;
    Some(Said { information, pull: ray.pixels.transpose() * Vector2::new(right?, down?) })
}

impl Odometer {
    /// Fills the fit's raster with vectors, evenly thinned.
    pub(super) fn look(&mut self, flow: &Flow<'_>, turn: &Turn, ground: &Ground) {
        let mut step = 1;
        while flow.grid.width.div_ceil(step) * flow.grid.height.div_ceil(step) > self.config.samples_max {
            step += 1;
        }
        let Some(lens) = &self.lens else { return };
        self.thinned.see(lens, flow.grid, step);
        let mut sights = std::mem::take(&mut self.fit.sights);
        let (view, rays) = (self.view(flow, lens, turn, ground), &self.thinned.rays);
        let sight = |(at, ray): (_, &Option<Ray>)| view.sight(at, ray.as_ref()?.at);
        sights.clear();
        sights.extend(cells(flow.grid, step).zip(rays).map(|cell| sight(cell).unwrap_or_default()));
        fill(&mut self.fit, sights, flow.grid, step);
    }

    /// What the gradients of every cell make of what the vectors agreed on.
    pub(super) fn hear(
        &mut self,
        flow: &Flow<'_>,
        gradients: &Gradients<'_>,
        agreed: &Agreed,
        turn: &Turn,
        ground: &Ground,
    ) -> Option<Found> {
        let lens = self.lens.as_ref()?;
        self.whole.see(lens, flow.grid, 1);
        let mut sights = std::mem::take(&mut self.every.sights);
        let (view, rays) = (self.view(flow, lens, turn, ground), &self.whole.rays);
        let sight = |(cell, (at, ray)): (usize, (_, &Option<Ray>))| {
            let ray = ray.as_ref()?;
            let said = said(gradients, cell, ray)?;
            Some(Sight { said: Some(said), ..view.sight(at, ray.at)? })
        };
        sights.clear();
        sights.extend(cells(flow.grid, 1).zip(rays).enumerate().map(|cell| sight(cell).unwrap_or_default()));
        fill(&mut self.every, sights, flow.grid, 1);
        self.every.by_gradients(agreed, &self.config, ground.lean_sd)
    }

    fn view<'a>(&'a self, flow: &'a Flow<'_>, lens: &'a Lens, turn: &Turn, ground: &Ground) -> View<'a> {
        let to_camera = self.mount.inverse();
        let back = to_camera * turn.rotation.to_rotation_matrix() * self.mount;
        View {
            flow,
            lens,
            back: *back.matrix(),
            normal: to_camera * ground.normal,
            leans: ground.lean_sd.map(|_| ground.tangents.map(|tangent| to_camera * tangent)),
            confidence_min: self.config.confidence_min,
            grazing_cosine_min: self.config.grazing_cosine_min,
        }
    }
}

fn fill(fit: &mut Fit, sights: Vec<Sight>, grid: Grid, step: usize) {
    let first = step / 2;
    fit.columns = (first..grid.width.max(first + 1)).step_by(step).count();
    fit.sights = sights;
}
