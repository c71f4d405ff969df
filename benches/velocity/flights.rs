//! Simulated flights: clean frames, what gyro and range say, and what is true, with errors of their own in every sensor.

use std::sync::Arc;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use nightflow::{
    camera::{Frame, Sample},
    clock::Stamp,
    darkness::{
        flight::{self, BLACK, Flight, Settings, TrueFlow, WHITE},
        ladder::MEANS,
        noise::{Noise, Normals},
    },
    motion::Config,
    wire::{CameraInfo, Image, Imu, Range},
};
use serde::{Deserialize, Serialize};

/// Frames a second.
const FPS: f64 = 30.0;
/// Mean of the clean frames, from which the others are darkened.
const CLEAN: f64 = 0.2;
/// What the simulated attitude lacks of the deviation that it states: it errs by 0.7 and 0.2 parts of it.
const TILT: f64 = 0.005 * 0.686;

/// What is flown.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// The flight's number and seed.
    pub number: u64,
    /// m/s; 0 hovers.
    pub speed: f64,
    /// Metres.
    pub height: f64,
    /// Steps; one frame more.
    pub steps: usize,
    /// Columns and rows of the camera.
    pub size: [usize; 2],
}

impl Plan {
    /// Speed and height are drawn evenly over their logarithms, 0.5–8 m/s and 2–30 m; every flight of so
    /// many as `hovers` says hovers.
    pub fn draw(number: u64, steps: usize, size: [usize; 2], hovers: u64) -> Plan {
        let mut draws = Normals::new(number, 0x91a7);
        let mut between = |low: f64, high: f64| low * (high / low).powf(draws.uniform());
        let (speed, height) = (between(0.5, 8.0), between(2.0, 30.0));
        Plan { number, speed: if number % hovers == hovers - 1 { 0.0 } else { speed }, height, steps, size }
    }

    /// Whether it hovers.
    pub fn hovers(&self) -> bool {
        self.speed == 0.0
    }
}

/// What is true at a frame.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Moment {
    /// The frame's stamp.
    pub stamp: Stamp,
    /// m/s, body (FLU).
    pub velocity: [f64; 3],
    /// rad/s, body (FLU).
    pub rates: [f64; 3],
    /// Metres over the ground.
    pub height: f64,
}

/// A flight without its frames.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Sensors {
    /// What was flown.
    pub plan: Plan,
    /// The calibration.
    pub info: CameraInfo,
    /// Gyro and attitude.
    pub imus: Vec<Imu>,
    /// Ranges along the body's down axis.
    pub ranges: Vec<Range>,
    /// One a frame.
    pub truth: Vec<Moment>,
}

/// A flight with its clean frames, 12 bits in 16.
pub struct Flown {
    /// All but the frames.
    pub sensors: Sensors,
    /// Counts, row by row.
    pub frames: Vec<Vec<u16>>,
    /// True flow from each frame to the next; none where the frames were kept in a file.
    pub flows: Vec<TrueFlow>,
}

/// Flies and draws the clean frames.
pub fn fly(plan: Plan) -> Result<Flown, String> {
    let settings = Settings {
        seed: plan.number,
        seconds: plan.steps as f64 / FPS,
        speed: plan.speed,
        height: plan.height,
        mean: [CLEAN; 2],
        size: plan.size,
        fps: FPS,
        noise: None,
    };
    let flight = Flight::new(settings).map_err(|error| error.to_string())?;
    let (mut imus, mut ranges, mut truth, mut frames, mut flows) = (vec![], vec![], vec![], vec![], vec![]);
    let info = flight.info(Stamp(0));
    for shot in flight {
        for sample in shot.samples {
            match sample {
                Sample::Imu(imu) => imus.push(Imu::clone(&imu)),
                Sample::Range(range) => ranges.push(Range::clone(&range)),
                Sample::Frame(frame) => {
                    frames
                        .push(frame.image.data.as_chunks::<2>().0.iter().map(|two| u16::from_le_bytes(*two)).collect());
                }
                Sample::Info(_) | Sample::Transforms(_) | Sample::Width(_) => {}
            }
        }
        let flight::Truth { stamp, velocity, rates, height, flow } = shot.truth;
        truth.push(Moment { stamp, velocity, rates, height });
        flows.extend(flow);
    }
    Ok(Flown { sensors: Sensors { plan, info, imus, ranges, truth }, frames, flows })
}

impl Flown {
    /// The frame as the camera takes it at a rung of the ladder: photons counted, read, 12 bits.
    pub fn photograph(&self, index: usize, rung: usize, camera: &Noise, stamp: Stamp) -> Frame {
        let [columns, rows] = self.sensors.plan.size;
        let factor = MEANS[rung] / CLEAN;
        let span = f64::from(WHITE - BLACK);
        let mut data = Vec::with_capacity(2 * columns * rows);
        for (row, clean) in self.frames[index].chunks_exact(columns).enumerate() {
            let mut draws = Normals::new(self.sensors.plan.number ^ 0xf11e, ((index * 7 + rung) << 16 | row) as u64);
            for (column, count) in clean.iter().enumerate() {
                let light = (f64::from(*count) - f64::from(BLACK)) / span * factor;
                let value = camera.counted(row % 2 + column % 2, light.clamp(0.0, 1.0), &mut draws);
                let count = (f64::from(BLACK) + value * span).round().clamp(0.0, f64::from(WHITE));
                data.extend((count as u16).to_le_bytes());
            }
        }
        let mut image = Image {
            height: rows as u32,
            width: columns as u32,
            encoding: "bayer_rggb16".into(),
            step: 2 * columns as u32,
            data,
            ..Image::default()
        };
        image.header.stamp = stamp.into();
        Frame { image, received: stamp }
    }
}

impl Sensors {
    /// The small samples and the frames' stamps as imperfect sensors give them: gyro bias, gyro clock, accelerometer bias, the
    /// rest of the attitude's error and the stamps' jitter are drawn as large as the settings say that they are.
    pub fn disturbed(&self, config: &Config) -> (Vec<Sample>, Vec<Stamp>) {
        let mut draws = Normals::new(self.plan.number, 0xd157);
        let mut three = |sd: f64| Vector3::from_fn(|_, _| sd * draws.draw());
        let (bias, tilt, late) = (three(config.gyro_bias_sd_rad_s), three(TILT), three(config.gyro_offset_sd_s).x);
        let tilt = UnitQuaternion::from_scaled_axis(Vector3::new(tilt.x, tilt.y, 0.0));
        // Of its own, so that what was drawn before there was an accelerometer stays what it was.
        let mut draws_of_force = Normals::new(self.plan.number, 0xacce);
        let push = Vector3::from_fn(|_, _| config.accelerometer_bias_sd_m_s2 * draws_of_force.draw());
        let mut samples: Vec<Sample> = vec![];
        for imu in &self.imus {
            let mut imu = imu.clone();
            imu.header.stamp = Stamp(Stamp::from(imu.header.stamp).ns() + (late * 1e9) as i64).into();
            let w = &mut imu.angular_velocity;
            (w.x, w.y, w.z) = (w.x + bias.x, w.y + bias.y, w.z + bias.z);
            let a = &mut imu.linear_acceleration;
            (a.x, a.y, a.z) = (a.x + push.x, a.y + push.y, a.z + push.z);
            let q = &mut imu.orientation;
            let turned = UnitQuaternion::from_quaternion(Quaternion::new(q.w, q.x, q.y, q.z)) * tilt;
            (q.w, q.x, q.y, q.z) = (turned.w, turned.i, turned.j, turned.k);
            samples.push(Sample::Imu(Arc::new(imu)));
        }
        samples.extend(self.ranges.iter().map(|range| Sample::Range(Arc::new(range.clone()))));
        samples.sort_by_key(Sample::stamp);
        let jitter =
            |moment: &Moment| Stamp(moment.stamp.ns() + (config.stamp_jitter_sd_s * draws.draw() * 1e9) as i64);
        let stamps = self.truth.iter().map(jitter).collect();
        (samples, stamps)
    }

    /// The true mean velocity between a frame and the one before, in the newer body's axes, and the true mean rate.
    pub fn mean(&self, newer: usize) -> (Vector3<f64>, Vector3<f64>) {
        let [a, b] = [&self.truth[newer - 1], &self.truth[newer]];
        let rates = 0.5 * (Vector3::from(a.rates) + Vector3::from(b.rates));
        let turned = UnitQuaternion::from_scaled_axis(rates * b.stamp.seconds_since(a.stamp));
        (0.5 * (turned.inverse() * Vector3::from(a.velocity) + Vector3::from(b.velocity)), rates)
    }

    /// The angles that the ground straight below moves by in so many seconds before a frame, about the body's X and Y
    /// (FRD): without the body's turn, and the turn.
    pub fn below(&self, newer: usize, seconds: f64) -> [[f64; 2]; 2] {
        let (velocity, rates) = self.mean(newer);
        let height = 0.5 * (self.truth[newer - 1].height + self.truth[newer].height);
        [[velocity.y, velocity.x].map(|v| (v * seconds / height).atan()), [rates.x, -rates.y].map(|w| w * seconds)]
    }
}
