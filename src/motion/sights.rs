//! What the fit looks at: rays of both ends of the vectors, the turn taken off, of a thinned raster; and of every cell what the
//! frames' gradients say of its vector.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::{
    Odometer,
    fit::{Agreed, Found, Said, Sight},
    gyro::Turn,
    lens::Lens,
    odometer::Ground,
    thinned::{Ray, Thinned, weight},
};
use crate::flow::{Flow, Gradients};

/// What a cell's sight is made of beside its own ray.
struct View<'a> {
    flow: &'a Flow<'a>,
    raster: Thinned,
    lens: &'a Lens,
    /// From the newer frame's axes to the older one's, optical.
    back: Matrix3<f64>,
    normal: Vector3<f64>,
    leans: Option<[Vector3<f64>; 2]>,
    confidence_min: f64,
    grazing_cosine_min: f64,
}

impl View<'_> {
    fn sight(&self, cell: (usize, usize), older: [f64; 2]) -> Option<Sight> {
        let ([u, v], confidence) = self.raster.seen(self.flow, cell)?;
        // Asked this way round, a NaN is left out.
        let usable = confidence >= self.confidence_min;
        if !usable {
            return None;
        }
        let [x, y] = self.raster.pixel(cell);
        let newer = self.lens.ray([x + u, y + v])?;
        let ray = Vector3::new(older[0], older[1], 1.0);
        let slope = self.normal.dot(&ray);
        let turned = self.back * Vector3::new(newer[0], newer[1], 1.0);
        if slope < self.grazing_cosine_min * ray.norm() || turned.z < 0.1 {
            return None;
        }
        let weight = weight(confidence);
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
    let pixels = ray.pixels?;
    let information = pixels.transpose() * Matrix2::new(xx, xy, xy, yy) * pixels;
    Some(Said { information, pull: pixels.transpose() * Vector2::new(right?, down?) })
}

impl Odometer {
    /// Fills the fit's raster with vectors, evenly thinned.
    pub(super) fn look(&mut self, flow: &Flow<'_>, turn: &Turn, ground: &Ground) {
        let Some(lens) = &self.lens else { return };
        let raster = Thinned::to(flow.grid, self.config.samples_max);
        self.thinned.see(lens, raster);
        let mut sights = std::mem::take(&mut self.fit.sights);
        let (view, rays) = (self.view(flow, raster, lens, turn, ground), &self.thinned.rays);
        let sight = |(at, ray): (_, &Option<Ray>)| view.sight(at, ray.as_ref()?.at);
        sights.clear();
        sights.extend(raster.cells().zip(rays).map(|cell| sight(cell).unwrap_or_default()));
        (self.fit.sights, self.fit.columns) = (sights, raster.columns());
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
        let raster = Thinned::whole(flow.grid);
        self.whole.see(lens, raster);
        let mut sights = std::mem::take(&mut self.every.sights);
        let (view, rays) = (self.view(flow, raster, lens, turn, ground), &self.whole.rays);
        let sight = |(cell, (at, ray)): (usize, (_, &Option<Ray>))| {
            let ray = ray.as_ref()?;
            let said = said(gradients, cell, ray)?;
            Some(Sight { said: Some(said), ..view.sight(at, ray.at)? })
        };
        sights.clear();
        sights.extend(raster.cells().zip(rays).enumerate().map(|cell| sight(cell).unwrap_or_default()));
        (self.every.sights, self.every.columns) = (sights, raster.columns());
        self.every.by_gradients(agreed, &self.config, ground.lean_sd)
    }

    fn view<'a>(
        &'a self,
        flow: &'a Flow<'_>,
        raster: Thinned,
        lens: &'a Lens,
        turn: &Turn,
        ground: &Ground,
    ) -> View<'a> {
        let to_camera = self.mount.inverse();
        let back = to_camera * turn.rotation.to_rotation_matrix() * self.mount;
        View {
            flow,
            raster,
            lens,
            back: *back.matrix(),
            normal: to_camera * ground.normal,
            leans: ground.lean_sd.map(|_| ground.tangents.map(|tangent| to_camera * tangent)),
            confidence_min: self.config.confidence_min,
            grazing_cosine_min: self.config.grazing_cosine_min,
        }
    }
}
