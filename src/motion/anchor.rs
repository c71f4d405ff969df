//! The frame that is kept for a while: when, where it is expected to have gone, and what it then says of the gyro's bias.
//!
//! A turn that the gyro makes up grows with time, and so does the bend that it leaves in the vectors; what they are off by does not.
//! Two frames of a hover that are a second apart show a bias thirty times as well as two that follow each other, and the mean velocity of
//! that second too.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use super::{
    Odometer, Scale, Velocity,
    bias::{Bias, Shown},
    fit::Found,
    fusion::Seen,
    gyro::Turn,
    inertia::Step,
    lens::Lens,
    odometer::Ground,
    thinned::{Ray, Thinned},
};
use crate::{
    clock::Stamp,
    flow::{Flow, Gradients, Grid},
};

/// A frame is kept for so long at most.
const AGE_S_MAX: f64 = 2.0;
/// It is first compared after so many intervals, and again after so many times as long.
const INTERVALS: f64 = 1.5;
const LONGER: f64 = 1.35;
/// Motion along the ground, over the distance to it, and turn, rad, after which too little of it is in sight.
const MOVED_MAX: f64 = 0.2;
const TURNED_MAX: f64 = 0.35;
/// Ground that is no plane bends vectors by so many times what the gyro's bias may bend them, where the motion is too fast to say anything.
const FAST: f64 = 2.0;
/// A turn that is left over, rad, and blows up the scatter: it is taken off, and what is left is looked at anew.
const LEFT_MAX: f64 = 2e-4;

/// What is to be done about the kept frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keeping {
    /// The newest frame is to be kept.
    Keep,
    /// The newest frame is to be compared with the kept one: see [`Odometer::expect`] and [`Odometer::look_back`].
    Compare,
    /// Nothing.
    Wait,
}

/// The kept frame, as the motion since then is known.
#[derive(Debug, Clone)]
pub(super) struct Anchor {
    /// Its stamp, and that of the newest frame.
    kept: Stamp,
    newest: Stamp,
    /// The distance to the ground then, where it was known.
    metres: Option<f64>,
    /// Where the body is, in its axes when the frame was kept: metres, or distances to the ground where that is not known.
    moved: Vector3<f64>,
    turned: UnitQuaternion<f64>,
    /// Seconds after which it is compared again.
    due_s: f64,
    /// What was believed then.
    before: Bias,
    /// Whether it has said something since.
    pub(super) heard: bool,
}

impl Odometer {
    /// What the newest step's velocity asks for.
    pub fn keep(&mut self, velocity: &Velocity) -> Keeping {
        if !self.config.keyframes || !self.config.gradients || self.rates.is_empty() {
            return Keeping::Wait;
        }
        let seconds = velocity.newer.seconds_since(velocity.older);
        let linear = Vector3::from(velocity.linear);
        let metres = match velocity.scale {
            Scale::Metric { distance } => Some(distance),
            Scale::PerDistance(_) => None,
        };
        let along = |moved: &Vector3<f64>| (moved.x * moved.x + moved.y * moved.y).sqrt() / metres.unwrap_or(1.0);
        if along(&linear) * self.config.ground_bend_sd > FAST * self.config.gyro_bias_sd_rad_s {
            self.let_go();
            return Keeping::Wait;
        }
        let turn = UnitQuaternion::from_scaled_axis(Vector3::from(velocity.angular) * seconds);
        if let Some(anchor) = self.anchor.as_mut().filter(|anchor| anchor.newest == velocity.older)
            && anchor.metres.is_some() == metres.is_some()
        {
            anchor.newest = velocity.newer;
            anchor.turned *= turn;
            anchor.moved += anchor.turned * linear * seconds;
            let age_s = anchor.newest.seconds_since(anchor.kept);
            let near = along(&anchor.moved) < MOVED_MAX && anchor.turned.angle() < TURNED_MAX && age_s < AGE_S_MAX;
            if near && age_s < anchor.due_s {
                return Keeping::Wait;
            }
            if near {
                anchor.due_s = LONGER * age_s;
                return Keeping::Compare;
            }
        }
        self.inertia.begin(self.between(velocity.older, velocity.newer).newer);
        self.anchor = Some(Anchor {
            kept: velocity.newer,
            metres,
            newest: velocity.newer,
            moved: Vector3::zeros(),
            turned: UnitQuaternion::identity(),
            due_s: INTERVALS * seconds,
            before: self.bias,
            heard: false,
        });
        Keeping::Keep
    }

    /// The kept frame is of no use any more: what came since has no velocity.
    pub fn let_go(&mut self) {
        self.anchor = None;
    }

    /// By how much what the kept frame shows in every cell of a raster is expected to have moved in the newest: camera pixels, right
    /// and down, NaN where it is nowhere.
    pub fn expect(&mut self, grid: &Grid, camera_size: [u32; 2], vectors: &mut Vec<f32>) -> Option<()> {
        let anchor = self.anchor.clone()?;
        let ground = self.ground(self.between(anchor.kept, anchor.newest));
        self.lens(camera_size).ok()?;
        let lens = self.lens.as_ref()?;
        self.whole.see(lens, Thinned::whole(*grid));
        let to_camera = self.mount.inverse();
        let Anchor { turned, metres, .. } = anchor;
        let arm = if metres.is_some() { Vector3::from(self.config.camera_offset_m) } else { Vector3::zeros() };
        let moved = (anchor.moved + turned * arm - arm) / metres.unwrap_or(1.0);
        let view = Expected {
            lens,
            forward: (to_camera * turned.inverse().to_rotation_matrix() * self.mount).into_inner(),
            tau: to_camera * moved,
            normal: to_camera * ground.normal,
        };
        let cells = Thinned::whole(*grid);
        vectors.clear();
        vectors.extend(cells.cells().zip(&self.whole.rays).flat_map(|(cell, ray)| {
            let pixel = cells.pixel(cell);
            let to = ray.as_ref().and_then(|ray| view.pixel(ray));
            to.map_or([f32::NAN; 2], |to| [to[0] - pixel[0], to[1] - pixel[1]].map(|along| along as f32))
        }));
        Some(())
    }

    /// Takes the flow from the kept frame to the newest. What it says of the gyro's bias takes the place of what the steps between them,
    /// and earlier comparisons with the same frame, said.
    pub fn look_back(&mut self, flow: &Flow<'_>, gradients: &Gradients<'_>, camera_size: [u32; 2]) {
        let said = self.anchor.clone().filter(|anchor| anchor.kept == flow.older && anchor.newest == flow.newer);
        let Some(anchor) = said else { return };
        match self.weigh(&anchor, flow, gradients, camera_size) {
            Some((bias, back)) => {
                self.bias = bias;
                self.anchor = Some(Anchor { heard: true, ..anchor });
                if let Some(back) = back {
                    self.inertia.look_back(&back, &bias.believed());
                }
            }
            None => self.let_go(),
        }
    }

    /// What both frames show of the bias, and how far the body has moved between them, as one step; `None` where that is none of these.
    fn weigh(
        &mut self,
        anchor: &Anchor,
        flow: &Flow<'_>,
        gradients: &Gradients<'_>,
        camera_size: [u32; 2],
    ) -> Option<(Bias, Option<Step>)> {
        let focal = self.lens(camera_size).ok()?.focal();
        let span = self.span(flow);
        let turn = self.turn(span).ok().filter(|turn| turn.swing_variance.is_some())?;
        let ground = self.ground(span);
        // The vectors' scatter is that of a turn that nobody took off unless it is: by what is believed, and then by what is found.
        let mut angle = self.bias.believed().mean().bias * span.seconds;
        let mut found = self.seen_from(flow, gradients, &turn, &ground, &angle)?;
        let left = found.leftover.as_ref()?.angle;
        if left.norm() > LEFT_MAX {
            angle += self.mount * left;
            found = self.seen_from(flow, gradients, &turn, &ground, &angle)?;
        }
        let left = found.leftover.as_ref()?;
        let alike = self.alike(&found, f64::from(flow.grid.scale[0]) / focal);
        let seen = Seen { turn: &turn, ground: &ground, found: &found, span, alike };
        let (to_camera, to_body) = (self.mount.inverse(), self.mount.matrix());
        let mut fit = self.fitted(&seen);
        // As if nothing had been taken off the turn.
        fit.linear += fit.by_turn(&found, to_camera.matrix(), span.seconds) * angle;
        let shown = to_camera * angle + left.angle;
        let mut bias = anchor.before;
        bias.pass(span.seconds, fit.passed);
        let before = bias.believed();
        let errors = self.errors(&before, &seen, &fit);
        let bulge = self.bulge(&seen);
        let noise = errors.passing() + left.covariance + Matrix3::identity() * (bulge * bulge);
        // The bias turned with the body.
        let half = UnitQuaternion::identity().slerp(&turn.rotation, 0.5).inverse().to_rotation_matrix().into_inner();
        let to_middle = half * to_body;
        let likely = bias.take(&Shown {
            angle: to_middle * shown,
            interval_s: span.seconds,
            noise: to_middle * noise * to_middle.transpose(),
            by_slope: to_middle * self.by_slope(&ground, &found),
            bent: alike.bent,
        });
        if !likely {
            self.bias.doubt();
            return None;
        }
        // How far the body has moved, where that is known in metres.
        let metric = self.leads() && ground.distance.is_ok();
        let heard = metric.then(|| errors.heard(&found, left, &fit, bulge, &shown)).flatten();
        Some((bias, heard.map(|heard| Step::new(&heard, &before, &turn, span))))
    }

    /// What both frames show once the gyro's turn, less `angle` (body axes of the kept frame), is taken off.
    fn seen_from(
        &mut self,
        flow: &Flow<'_>,
        gradients: &Gradients<'_>,
        turn: &Turn,
        ground: &Ground,
        angle: &Vector3<f64>,
    ) -> Option<Found> {
        let turn = Turn { rotation: UnitQuaternion::from_scaled_axis(-angle) * turn.rotation, ..*turn };
        self.look(flow, &turn, ground);
        let seed = u64::from(self.config.seed) ^ flow.older.ns().cast_unsigned();
        let agreed = self.fit.solve(&self.config, ground.lean_sd, seed).ok()?;
        self.hear(flow, gradients, &agreed, &turn, ground)
    }
}

/// Where a ray of the kept frame is seen in the newest.
struct Expected<'a> {
    lens: &'a Lens,
    /// From the kept frame's optical axes to the newest's.
    forward: Matrix3<f64>,
    tau: Vector3<f64>,
    normal: Vector3<f64>,
}

impl Expected<'_> {
    fn pixel(&self, ray: &Ray) -> Option<[f64; 2]> {
        let ray = Vector3::new(ray.at[0], ray.at[1], 1.0);
        let slope = self.normal.dot(&ray);
        if slope < 0.1 * ray.norm() {
            return None;
        }
        let seen = self.forward * (ray / slope - self.tau);
        if seen.z < 0.1 * seen.norm() {
            return None;
        }
        self.lens.pixel([seen.x / seen.z, seen.y / seen.z])
    }
}
