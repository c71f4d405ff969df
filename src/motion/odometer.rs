//! The odometer: keeps gyro, range and calibration, and turns each step's flow into the body's velocity.

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};

use super::{
    AttitudeUse, Config, Diagnosis, Drift, Error, GyroUse, Lack, Mount, NoDistance, Velocity,
    anchor::Anchor,
    bias::Bias,
    drift::{Turned, Watch},
    errors::Alike,
    fit::{Fit, Found},
    fusion::Seen,
    ground::Ranges,
    gyro::{Rates, Turn},
    inertia::Inertia,
    lens::Lens,
    mounting::Mounting,
    obstacles::Sighting,
    plane::Plane,
    thinned::Rays,
};
use crate::{
    clock::Stamp,
    flow::{Flow, Gradients},
    wire::{CameraInfo, Imu, Range, TfMessage},
};

/// The body as good as stands still where it turns across the optical axis by more than this, radians, …
const STILL_TURN_MIN: f64 = 3e-3;
/// … and what the gyro leaves of the flow is less than this part of that turn.
const STILL_PART: f64 = 0.3;

/// Velocity from flow over the ground. It allocates nothing after its first step.
#[derive(Debug)]
pub struct Odometer {
    pub(super) config: Config,
    /// Brings optical axes to body axes.
    pub(super) mount: Rotation3<f64>,
    beam: Vector3<f64>,
    pub(super) lens: Option<Lens>,
    /// Where the transforms are to say how the camera sits, and whether they did.
    mounting: Option<Mounting>,
    pub(super) mounted: bool,
    /// Every second cell or so, as many as are looked at, and all of them.
    pub(super) thinned: Rays,
    pub(super) whole: Rays,
    pub(super) rates: Rates,
    ranges: Ranges,
    pub(super) fit: Fit,
    /// What gradients say, of every cell.
    pub(super) every: Fit,
    pub(super) plane: Plane,
    watch: Watch,
    pub(super) bias: Bias,
    pub(super) anchor: Option<Anchor>,
    pub(super) inertia: Inertia,
    /// From a frame's stamp to the middle of its exposure.
    half_exposure_ns: i64,
}

/// The ground as seen from the older frame.
pub(super) struct Ground {
    /// Unit vector to the ground, body axes.
    pub(super) normal: Vector3<f64>,
    /// The two directions that it may be off in.
    pub(super) tangents: [Vector3<f64>; 2],
    /// How far it may be off where it is given, and where it is fitted.
    pub(super) tilt_sd: f64,
    pub(super) lean_sd: Option<f64>,
    pub(super) distance: Result<Distance, NoDistance>,
}

/// The middles of both exposures.
#[derive(Clone, Copy)]
pub(super) struct Span {
    pub(super) older: Stamp,
    pub(super) newer: Stamp,
    pub(super) seconds: f64,
}

pub(super) struct Distance {
    pub(super) metres: f64,
    pub(super) sd: f64,
    /// The point that the beam hit, from the camera, body axes: how a tilt's error changes the distance.
    pub(super) hit: Vector3<f64>,
}

impl Odometer {
    /// Checks the settings.
    pub fn new(config: &Config) -> Result<Odometer, Error> {
        let mount = match config.camera {
            Mount::Downward => axes([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
            Mount::Forward => axes([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
            Mount::Tf => Rotation3::identity(),
            Mount::Quaternion(q) => unit("camera", q)?.to_rotation_matrix(),
        };
        let beam = Vector3::from(config.range_direction);
        if beam.norm() < 1e-6 || !beam.norm().is_finite() {
            return Err(Error::Settings(format!(
                "range_direction is {:?}, a direction is needed",
                config.range_direction
            )));
        }
        if config.samples_max < config.inliers_min as usize {
            return Err(Error::Settings(format!(
                "samples_max is {}, at least inliers_min = {} is needed",
                config.samples_max, config.inliers_min
            )));
        }
        let imu = unit("imu_quaternion", config.imu_quaternion)?;
        Ok(Odometer {
            config: config.clone(),
            mount,
            beam: beam.normalize(),
            lens: None,
            mounting: (config.camera == Mount::Tf).then(Mounting::default),
            mounted: config.camera != Mount::Tf,
            thinned: Rays::default(),
            whole: Rays::default(),
            rates: Rates::new(imu),
            ranges: Ranges::new(),
            fit: Fit::default(),
            every: Fit::default(),
            plane: Plane::default(),
            watch: Watch::default(),
            bias: Bias::new(config.gyro_bias_sd_rad_s),
            anchor: None,
            inertia: Inertia::default(),
            half_exposure_ns: 0,
        })
    }

    /// For a camera whose stamps are the beginnings of exposures that last `exposure_s`.
    pub fn exposing(mut self, exposure_s: f64) -> Odometer {
        self.half_exposure_ns = (0.5e9 * exposure_s).round() as i64;
        self
    }

    /// For a vehicle whose own frame has this name, where the transforms tell how the camera sits.
    pub fn standing_in(mut self, body_frame: &str) -> Odometer {
        if let Some(mounting) = &mut self.mounting {
            mounting.body(body_frame);
        }
        self
    }

    /// How well gyro and camera agree on the body's turns, once there were enough of them.
    pub fn drift(&self) -> Option<Drift> {
        self.watch.found()
    }

    /// What they disagree on beyond doubt.
    pub fn diagnosis(&self) -> Option<Diagnosis> {
        self.drift()?.diagnosis(&self.config)
    }

    /// Takes a calibration.
    pub fn info(&mut self, info: &CameraInfo) -> Result<(), Error> {
        let lens = Lens::read(info)?;
        if self.lens != lens {
            self.let_go();
        }
        self.lens = lens;
        if self.mounting.as_mut().is_some_and(|mounting| mounting.camera(&info.header.frame_id)) {
            self.mount();
        }
        Ok(())
    }

    /// Takes transforms; refuses those that are none, and takes the others of the same message.
    pub fn transforms(&mut self, message: &TfMessage) -> Result<(), Error> {
        let Some(mounting) = &mut self.mounting else { return Ok(()) };
        let kept = mounting.keep(message);
        self.mount();
        kept
    }

    /// The camera sits as the transforms say by now.
    fn mount(&mut self) {
        let found = self.mounting.as_ref().and_then(Mounting::find);
        self.mounted = found.is_some();
        if let Some(stands) = found {
            let mount = stands.rotation.to_rotation_matrix();
            if mount != self.mount {
                self.let_go();
            }
            self.mount = mount;
            self.config.camera_offset_m = stands.translation.vector.into();
        }
    }

    /// Takes a gyro sample; refuses one that is not finite or whose clock went back.
    pub fn imu(&mut self, imu: &Imu) -> Result<(), Error> {
        let kept = self.rates.keep(imu, &self.config);
        if matches!(kept, Err(Error::Backwards { anew: true, .. })) {
            // It may be another gyro, or this one on another day.
            self.bias = Bias::new(self.config.gyro_bias_sd_rad_s);
            self.inertia.forget();
            self.let_go();
        }
        kept
    }

    /// Takes a range; refuses one that is not a number or whose clock went back.
    pub fn range(&mut self, range: &Range) -> Result<(), Error> {
        self.ranges.keep(range)
    }

    /// The body's velocity by the flow between two frames of `camera_size` (columns, rows).
    pub fn velocity(&mut self, flow: &Flow<'_>, camera_size: [u32; 2]) -> Result<Velocity, Lack> {
        self.velocity_with(flow, None, camera_size)
    }

    /// The same, with the frames' gradients at hand: they know more than the vectors, each of which is made of many cells' words.
    pub fn velocity_with(
        &mut self,
        flow: &Flow<'_>,
        gradients: Option<Gradients<'_>>,
        camera_size: [u32; 2],
    ) -> Result<Velocity, Lack> {
        let focal = self.lens(camera_size)?.focal();
        let span = self.span(flow);
        if span.seconds <= 0.0 {
            return Err(Lack::Degenerate);
        }
        let cell = f64::from(flow.grid.scale[0]) / focal;
        let turn = self.turn(span)?;
        let mut ground = self.ground(span);
        self.look(flow, &turn, &ground);
        let seed = u64::from(self.config.seed) ^ flow.older.ns().cast_unsigned();
        let agreed = self.fit.solve(&self.config, ground.lean_sd, seed)?;
        let heard = gradients.filter(|_| self.config.gradients);
        let heard = heard.and_then(|gradients| self.hear(flow, &gradients, &agreed, &turn, &ground));
        let found = match (heard, self.fit.conclude(&agreed, ground.lean_sd)) {
            (Some(heard), Some(seen)) => heard.beside(&seen, self.alike(&seen, cell).shared),
            (heard, seen) => heard.or(seen).ok_or(Lack::Degenerate)?,
        };
        self.compare(&turn, &found, span);
        let alike = self.alike(&found, cell);
        if ground.lean_sd.is_some() {
            let [a, b] = ground.tangents;
            ground.normal = (ground.normal + a * found.lean[0] + b * found.lean[1]).normalize();
            ground.distance = self.distance(span, &ground.normal);
        }
        let velocity = self.conclude(&Seen { turn: &turn, ground: &ground, found: &found, span, alike });
        Ok(Velocity { older: flow.older, newer: flow.newer, ..velocity })
    }

    /// What all vectors may err by together, of a raster whose cells are so many radians wide.
    pub(super) fn alike(&self, found: &Found, cell: f64) -> Alike {
        let constant = self.config.flow_shared_sd_cells * cell;
        let shared = (constant.powi(2) + (self.config.flow_shared_sd_part * found.stretch).powi(2)).sqrt();
        let bent = if found.by_gradients { shared.hypot(self.config.flow_bend_sd_cells * cell) } else { shared };
        Alike { shared, bent }
    }

    /// The lens of frames of this size (columns, rows), once it is known how it sits.
    pub(super) fn lens(&self, camera_size: [u32; 2]) -> Result<&Lens, Lack> {
        let lens = self.lens.as_ref().ok_or(Lack::Calibration)?;
        if !self.mounted {
            return Err(Lack::Mount);
        }
        if lens.size() != [0, 0] && lens.size() != camera_size {
            return Err(Lack::CameraSize { calibrated: lens.size(), frame: camera_size });
        }
        Ok(lens)
    }

    /// How the body turned between two frames and where up is, for whoever looks for more than the ground.
    pub(super) fn sighting(&self, flow: &Flow<'_>, camera_size: [u32; 2]) -> Result<Sighting, Lack> {
        self.lens(camera_size)?;
        let span = self.span(flow);
        if span.seconds <= 0.0 {
            return Err(Lack::Degenerate);
        }
        let turn = self.turn(span)?.rotation;
        let stated = match self.config.attitude {
            AttitudeUse::Imu => self.rates.up_at(span.newer, self.config.range_age_s_max),
            AttitudeUse::Level | AttitudeUse::Fit => None,
        };
        let up = stated.map_or_else(Vector3::z, |(up, _)| up);
        Ok(Sighting { mount: *self.mount.matrix(), turn, up, interval_s: span.seconds })
    }

    /// From the middle of the older exposure to the middle of the newer one.
    pub(super) fn span(&self, flow: &Flow<'_>) -> Span {
        self.between(flow.older, flow.newer)
    }

    /// The same for frames of these stamps.
    pub(super) fn between(&self, older: Stamp, newer: Stamp) -> Span {
        let middle = |stamp: Stamp| Stamp(stamp.ns().saturating_add(self.half_exposure_ns));
        let (older, newer) = (middle(older), middle(newer));
        Span { older, newer, seconds: newer.seconds_since(older) }
    }

    /// How the body turned, or how it may have where that need not be known.
    pub(super) fn turn(&self, span: Span) -> Result<Turn, Lack> {
        let measured = match self.rates.is_empty() {
            true => Err(Lack::Gyro),
            false => self.rates.turn(span.older, span.newer, &self.config),
        };
        match (measured, self.config.gyro) {
            (Err(_), GyroUse::IfPresent) => Ok(Turn {
                rotation: UnitQuaternion::identity(),
                mean: Vector3::zeros(),
                first: Vector3::zeros(),
                last: Vector3::zeros(),
                variance: (self.config.rate_unknown_sd_rad_s * span.seconds).powi(2),
                swing_variance: None,
            }),
            (measured, _) => measured,
        }
    }

    pub(super) fn ground(&self, span: Span) -> Ground {
        let config = &self.config;
        let stated = match config.attitude {
            AttitudeUse::Imu => self.rates.up_at(span.older, config.range_age_s_max),
            AttitudeUse::Level | AttitudeUse::Fit => None,
        };
        let (up, tilt_sd) = stated.unwrap_or((Vector3::z(), config.level_sd_rad));
        let normal = -up;
        let side = normal.cross(&Vector3::x()).try_normalize(0.1).unwrap_or_else(Vector3::y);
        let lean_sd = (config.attitude == AttitudeUse::Fit).then_some(config.lean_sd_rad);
        Ground {
            normal,
            tangents: [side, normal.cross(&side)],
            tilt_sd: if lean_sd.is_some() { 0.0 } else { tilt_sd },
            lean_sd,
            distance: self.distance(span, &normal),
        }
    }

    /// From the camera to the ground along its normal.
    fn distance(&self, span: Span, normal: &Vector3<f64>) -> Result<Distance, NoDistance> {
        let config = &self.config;
        let beam = self.ranges.at(span.older, span.newer, config)?;
        let cosine = normal.dot(&self.beam);
        let hit = Vector3::from(config.range_offset_m) - Vector3::from(config.camera_offset_m) + self.beam * beam.range;
        let metres = normal.dot(&hit);
        if cosine < config.beam_cosine_min || metres <= 0.0 {
            return Err(NoDistance::Slanting { cosine, needed: config.beam_cosine_min });
        }
        Ok(Distance { metres, sd: cosine * beam.variance.sqrt(), hit })
    }

    /// Keeps what the flow shows of the turn beside what the gyro says.
    ///
    /// A turn about the optical axis looks like no motion over the ground. A turn across it differs from a shift by its
    /// curvature alone, and so does a motion over ground that bends; it is compared only where the body as good as stands
    /// still.
    fn compare(&mut self, turn: &Turn, found: &Found, span: Span) {
        let (Some(leftover), Some(swing_variance)) = (found.leftover, turn.swing_variance) else { return };
        let mount = self.mount.matrix();
        let axis: Vector3<f64> = mount.column(2).into();
        let across = |angle: &Vector3<f64>| (angle - axis * axis.dot(angle)).norm();
        let angle = turn.mean * span.seconds;
        let still = mount * leftover.still.0;
        let (leftover, information) = if across(&angle) > STILL_TURN_MIN && across(&still) < STILL_PART * across(&angle)
        {
            (still, mount * leftover.still.1 * mount.transpose())
        } else {
            let Some(covariance) = leftover.information.try_inverse() else { return };
            (axis * leftover.angle.z, axis * axis.transpose() / covariance[(2, 2)])
        };
        self.watch.take(&Turned {
            leftover,
            information,
            angle,
            swing: turn.last - turn.first,
            swing_variance,
            interval_s: span.seconds,
        });
    }
}

fn axes(rows: [[f64; 3]; 3]) -> Rotation3<f64> {
    Rotation3::from_matrix_unchecked(Matrix3::from_fn(|i, j| rows[i][j]))
}

fn unit(key: &str, [x, y, z, w]: [f64; 4]) -> Result<UnitQuaternion<f64>, Error> {
    let quaternion = Quaternion::new(w, x, y, z);
    if quaternion.norm() < 1e-6 || !quaternion.norm().is_finite() {
        return Err(Error::Settings(format!("{key} is ({x}, {y}, {z}, {w}), no rotation")));
    }
    Ok(UnitQuaternion::from_quaternion(quaternion))
}
