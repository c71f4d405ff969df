//! One cell of the flow as a pair of rays, and what its length along the line through the focus of expansion says.
//!
//! With m₁ = (x, y, 1) the ray of the older frame, p₂ = (x′, y′, 1) that of the newer one turned back into the older
//! frame's axes, and T the camera's displacement, Z₂ p₂ = Z₁ m₁ − T. With t = T / |T| and pull = (x t_z − t_x, y t_z − t_y)
//! that is p₂ − m₁ = (|T| / Z₂) · pull: every vector lies along its pull, and its length gives the point's distance in
//! displacements. Divided by the part of the ray that lies along t it is the inverse of the time to contact, exactly.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::{
    Config,
    heading::Heading,
    texture::{self, Information},
};

/// Rays that lie further aside of the motion than this cosine say nothing about contact.
const AHEAD_MIN: f64 = 0.1;

/// A cell of the thinned raster.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Cell {
    /// Whether its flow is to be used: confident, textured, with a ray at both ends.
    pub(super) seen: bool,
    /// Whether it has a ray at all.
    pub(super) shown: bool,
    /// (x, y) of the older ray.
    pub(super) older: [f64; 2],
    /// (x, y) of the newer ray in the older frame's axes.
    pub(super) newer: [f64; 2],
    /// Relative inverse variance by the confidence.
    pub(super) weight: f64,
    /// What its texture knows of its displacement, in developed pixels.
    pub(super) texture: Information,
    /// Something that moves by itself.
    pub(super) moving: bool,
    /// Nearest sector, and where it looks against the level: up over forward of the motion.
    pub(super) sector: usize,
    pub(super) slope: f64,
    /// Length of the newer ray over its part along the motion.
    pub(super) stretch: f64,
    /// Inverse time to contact at the newer frame, 1/s; its own deviation; its change with a shift of all vectors and
    /// with the two directions in which the heading may be off.
    pub(super) closing: f64,
    pub(super) sd: f64,
    pub(super) by_shift: Vector2<f64>,
    pub(super) by_heading: Vector2<f64>,
    /// Whether `closing` and what belongs to it are known.
    pub(super) known: bool,
    /// Residual across the line in deviations, and in radians.
    pub(super) off_sds: f64,
    pub(super) off: f64,
    /// Length along the line in deviations: negative towards the focus.
    pub(super) along_sds: f64,
}

/// What is the same for all cells of a step.
pub(super) struct Scene<'a> {
    pub(super) config: &'a Config,
    pub(super) heading: &'a Heading,
    /// Older optical axes to the level body frame of the newer frame.
    pub(super) level: Matrix3<f64>,
    pub(super) interval_s: f64,
    /// Radians a developed pixel.
    pub(super) pixel: f64,
}

impl Cell {
    pub(super) fn shift(&self) -> Vector2<f64> {
        Vector2::new(self.newer[0] - self.older[0], self.newer[1] - self.older[1])
    }

    /// The direction of the vector of a point that stands still, as long as the vector of one at depth |T| is.
    pub(super) fn pull(&self, t: &Vector3<f64>) -> Vector2<f64> {
        Vector2::new(self.older[0] * t.z - t.x, self.older[1] * t.z - t.y)
    }

    /// Distance of the vector's end from the line through the focus of expansion, radians.
    pub(super) fn residual(&self, t: &Vector3<f64>) -> f64 {
        let (shift, pull) = (self.shift(), self.pull(t));
        let length = pull.norm();
        if length > 1e-9 { (shift.x * pull.y - shift.y * pull.x) / length } else { 0.0 }
    }

    /// Where the cell looks, for every cell that has a ray: whether it may have been seen or not.
    pub(super) fn place(&mut self, scene: &Scene<'_>) {
        let ray = Vector3::new(self.newer[0], self.newer[1], 1.0);
        let path = scene.level * scene.heading.direction;
        (self.sector, self.slope, self.stretch) = bearing(&(scene.level * ray), &path);
    }

    /// What its vector says of a point that stands still.
    pub(super) fn measure(&mut self, scene: &Scene<'_>) {
        let (t, heading) = (scene.heading.direction, scene.heading);
        let (shift, pull) = (self.shift(), self.pull(&t));
        let (length, ray) = (pull.norm(), Vector3::new(self.newer[0], self.newer[1], 1.0));
        let ahead = ray.dot(&t);
        let along = pull / length;
        let shown_px = texture::sd_along(self.texture, along.into());
        // Where the texture runs along the line, a network fills the vector in from elsewhere.
        self.known = self.seen && length > 1e-6 && ahead > AHEAD_MIN && shown_px <= scene.config.texture_sd_px_max;
        if !self.known {
            return;
        }
        let stated = heading.spread / self.weight.sqrt();
        let shown = shown_px * scene.pixel;
        let across = texture::sd_along(self.texture, [-along.y, along.x]) * scene.pixel;
        let sd = hypot(stated, shown);
        self.off = self.residual(&t);
        self.off_sds = self.off.abs() / hypot(stated, across);
        self.along_sds = shift.dot(&along) / sd;
        let per = 1.0 / (length * ahead * scene.interval_s);
        self.closing = shift.dot(&along) * per;
        self.sd = sd * per;
        self.by_shift = along * per;
        self.by_heading = Vector2::from_fn(|i, _| {
            let e = heading.tangents[i];
            let by = Vector2::new(self.older[0] * e.z - e.x, self.older[1] * e.z - e.y);
            let turned = (shift.dot(&by) - 2.0 * shift.dot(&along) * along.dot(&by)) / length;
            turned * per - self.closing * ray.dot(&e) / ahead
        });
    }
}

/// The sector of a ray, how steep it is against the path (up over forward), and its length over its part ahead; infinite
/// where it does not look ahead. Both in the level frame.
pub(super) fn bearing(look: &Vector3<f64>, path: &Vector3<f64>) -> (usize, f64, f64) {
    let (sector, ahead) = (super::sector_of(look.y.atan2(look.x)), look.dot(path));
    match ahead > 1e-6 {
        true => (sector, (look - path * ahead).z / ahead, look.norm() / ahead),
        false => (sector, f64::INFINITY, f64::INFINITY),
    }
}

/// The root is exact to the bit on every machine, `hypot` is not.
pub(super) fn hypot(a: f64, b: f64) -> f64 {
    (a * a + b * b).sqrt()
}
