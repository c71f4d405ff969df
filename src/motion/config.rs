//! `[motion]`: the vehicle's geometry, what its sensors are worth, and how strict the fit is.

use serde::{Deserialize, Serialize};

/// `[motion]`. Body frame: FLU (x forward, y left, z up). Quaternions are (x, y, z, w).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// How the camera's optical frame (x right, y down, z forward) stands in the body.
    pub camera: Mount,
    /// Where the camera sits in the body, metres.
    pub camera_offset_m: [f64; 3],
    /// Rotation that brings the IMU's axes to the body's.
    pub imu_quaternion: [f64; 4],
    /// Where the range finder sits in the body, metres.
    pub range_offset_m: [f64; 3],
    /// Where the range finder looks, in the body.
    pub range_direction: [f64; 3],
    /// Whether a velocity without the gyro's word is given.
    pub gyro: GyroUse,
    /// Where the ground's normal comes from.
    pub attitude: AttitudeUse,
    /// Two gyro samples further apart than this leave a gap; at the ends a rate is held for at most this long.
    pub gyro_gap_s_max: f64,
    /// Noise of a gyro sample, where its message states none.
    pub gyro_sd_rad_s: f64,
    /// Bias that the gyro may have.
    pub gyro_bias_sd_rad_s: f64,
    /// By how much the gyro's clock and the camera's may differ.
    pub gyro_offset_sd_s: f64,
    /// Change of the body rate that is expected where a rate had to be held.
    pub spin_sd_rad_s2: f64,
    /// Body rate that is to be expected where there is no gyro.
    pub rate_unknown_sd_rad_s: f64,
    /// Jitter of a frame's stamp.
    pub stamp_jitter_sd_s: f64,
    /// Error of the attitude, where its message states none.
    pub attitude_sd_rad: f64,
    /// Error of taking the body's up for the ground's normal.
    pub level_sd_rad: f64,
    /// How far the body's up may be off the ground's normal where the flow shows the normal.
    pub lean_sd_rad: f64,
    /// A range older than this at the newer frame gives no distance.
    pub range_age_s_max: f64,
    /// Constant part of the range's noise, where its message states none.
    pub range_sd_m: f64,
    /// Part of the range's noise that grows with the range, where its message states none.
    pub range_sd_part: f64,
    /// Speed at which the distance may change while the range is held.
    pub climb_sd_m_s: f64,
    /// The least cosine between the range finder's beam and the ground's normal.
    pub beam_cosine_min: f64,
    /// The least cosine between a pixel's ray and the ground's normal: what is nearer to the horizon is left out.
    pub grazing_cosine_min: f64,
    /// Vectors of a lower confidence are left out.
    pub confidence_min: f64,
    /// The most vectors that are looked at; the raster is thinned evenly.
    pub samples_max: usize,
    /// Whether what the frames' gradients say in every cell has the last word on the velocity, where `[flow] refine` has them.
    pub gradients: bool,
    /// Whether accelerometer and attitude, where the gyro's messages have them (and `attitude` is `imu`), carry the velocity from
    /// step to step. `false` gives every step's own word, as who has an accelerometer himself wants it.
    pub inertia: bool,
    /// Whether a frame is kept for up to two seconds of a hover and compared with those after it, where `[flow] refine` has gradients:
    /// it shows the gyro's bias better than frames that follow each other.
    pub keyframes: bool,
    /// Noise of an accelerometer sample, where its message states none.
    pub accelerometer_sd_m_s2: f64,
    /// Bias that the accelerometer may have.
    pub accelerometer_bias_sd_m_s2: f64,
    /// The fewest vectors that must agree.
    pub inliers_min: u32,
    /// The least part of the vectors that must agree.
    pub inlier_part_min: f64,
    /// A vector agrees with a first guess of the motion within this angle.
    pub seed_rad: f64,
    /// No vector agrees that is further off than this angle.
    pub agree_rad_max: f64,
    /// Flow error that all vectors of a step share, in cells of a raster of a quarter of the network's resolution.
    pub flow_shared_sd_cells: f64,
    /// Flow error that all vectors of a step share, as a part of their length.
    pub flow_shared_sd_part: f64,
    /// By how much an error that cells share may differ over the image where gradients have the last word, in such cells.
    pub flow_bend_sd_cells: f64,
    /// How far the ground may be from a plane: by what part of the distance it bends where a ray's slope is 1.
    pub ground_bend_sd: f64,
    /// How much the ground may slope, where the gyro's bias is learnt.
    pub ground_slope_sd: f64,
    /// By what part of the distance things may stand above the ground that vectors are too noisy to tell from it.
    pub ground_relief_sd: f64,
    /// Clocks of gyro and camera that are further apart than this are said to be so.
    pub clock_offset_s_max: f64,
    /// A flow that turns further or less far than the gyro by more than this part is said to do so.
    pub turn_scale_off_max: f64,
    /// Seed of the random draws.
    pub seed: u32,
    /// Whether it is looked for what is in the way, and how; `None` (absent) looks for nothing.
    pub obstacles: Option<super::obstacles::Config>,
}

/// How the camera's optical frame stands in the body.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mount {
    /// Looks down, the image's top is forward.
    Downward,
    /// Looks forward, the image's top is up.
    Forward,
    /// As `/tf_static` has it: [`super::Odometer::standing_in`] names the body's frame, the calibration the camera's. The
    /// camera's offset is taken from there too.
    Tf,
    /// Rotation (x, y, z, w) that brings optical axes to body axes.
    Quaternion([f64; 4]),
}

/// Whether a velocity without the gyro's word is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GyroUse {
    /// No gyro over the interval, no velocity.
    Required,
    /// Without a gyro the body is taken as not turning, and the covariance says what that costs.
    IfPresent,
}

/// Where the ground's normal comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AttitudeUse {
    /// The IMU's orientation where it gives one, the body's up otherwise.
    Imu,
    /// Always the body's up.
    Level,
    /// Nobody knows it: the flow itself shows it (a homography's normal), held to the body's up by `lean_sd_rad`.
    Fit,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            camera: Mount::Downward,
            camera_offset_m: [0.0; 3],
            imu_quaternion: [0.0, 0.0, 0.0, 1.0],
            range_offset_m: [0.0; 3],
            range_direction: [0.0, 0.0, -1.0],
            gyro: GyroUse::Required,
            attitude: AttitudeUse::Imu,
            gyro_gap_s_max: 0.02,
            gyro_sd_rad_s: 0.005,
            gyro_bias_sd_rad_s: 0.003,
            gyro_offset_sd_s: 0.001,
            spin_sd_rad_s2: 5.0,
            rate_unknown_sd_rad_s: 0.2,
            stamp_jitter_sd_s: 1e-4,
            attitude_sd_rad: 0.01,
            level_sd_rad: 0.05,
            lean_sd_rad: 0.2,
            range_age_s_max: 0.2,
            range_sd_m: 0.02,
            range_sd_part: 0.01,
            climb_sd_m_s: 1.0,
            beam_cosine_min: 0.5,
            grazing_cosine_min: 0.1,
            confidence_min: 0.05,
            samples_max: 1200,
            gradients: true,
            inertia: true,
            keyframes: true,
            accelerometer_sd_m_s2: 0.2,
            accelerometer_bias_sd_m_s2: 0.05,
            inliers_min: 60,
            inlier_part_min: 0.25,
            seed_rad: 0.004,
            agree_rad_max: 0.015,
            flow_shared_sd_cells: 0.0005,
            flow_shared_sd_part: 0.001,
            flow_bend_sd_cells: 0.002,
            ground_bend_sd: 0.05,
            ground_slope_sd: 0.03,
            ground_relief_sd: 0.02,
            clock_offset_s_max: 0.002,
            turn_scale_off_max: 0.1,
            seed: 1,
            obstacles: None,
        }
    }
}

/// Why each default is what it is, by its key.
pub const REASONS: &[(&str, &str)] = &[
    ("camera", "velocity over ground is what most drones want first, and their flow camera looks down"),
    ("camera_offset_m", "unknown until measured; 0.1 m at 1 rad/s is 0.1 m/s"),
    ("imu_quaternion", "autopilots give their IMU in body axes already"),
    ("range_offset_m", "unknown until measured"),
    ("range_direction", "height sensors look down"),
    ("gyro", "turning looks like moving: at 5 m a rate of 0.1 rad/s not taken off is 0.5 m/s of phantom speed"),
    ("attitude", "a tilt of 0.1 rad changes the distance by what the cosine says, and the plane's shape by more"),
    ("gyro_gap_s_max", "four periods at 200 Hz: a lost sample is bridged, a lost sensor is not"),
    ("gyro_sd_rad_s", "a consumer MEMS gyro of 0.007 °/s/√Hz in a band of 1 kHz, with room for vibration"),
    ("gyro_bias_sd_rad_s", "10 °/min is left of a MEMS bias after a calibration at start"),
    ("gyro_offset_sd_s", "what is left after stamps are taken at the middle of the exposure"),
    ("spin_sd_rad_s2", "an ordinary quadrotor in gusts; it only matters for the few ms that a rate is held"),
    ("rate_unknown_sd_rad_s", "a hovering multicopter's rates in light wind"),
    ("stamp_jitter_sd_s", "a stamp taken in the driver's interrupt"),
    ("attitude_sd_rad", "0.6° is what a small AHRS holds"),
    ("level_sd_rad", "3°: a multicopter at low speed and ground that is nearly level"),
    ("lean_sd_rad", "11°: a multicopter in wind, or a slope; a slow flight shows no normal, and this is all there is"),
    ("range_age_s_max", "four periods of a 20 Hz range finder"),
    ("range_sd_m", "time-of-flight sensors state 2 cm near by"),
    ("range_sd_part", "and 1 % further away"),
    ("climb_sd_m_s", "an ordinary climb or descent"),
    ("beam_cosine_min", "at 60° the beam's footprint and the tilt's error make a height worthless"),
    ("grazing_cosine_min", "6° below the horizon the ground is ten heights away and its slope decides"),
    ("confidence_min", "a vector that is right once in twenty times only adds outliers"),
    (
        "samples_max",
        "errors of neighbouring network cells are alike, so that more vectors cost time and add no knowledge",
    ),
    (
        "gradients",
        "true: a vector is what many cells say, and counts like any other; cell by cell and by their texture the same frames say a fifth to a \
         third more exactly how the camera moved and turned (models/velocity.md)",
    ),
    (
        "inertia",
        "true: steps together err by 14 to 35 % less than each (models/velocity.md); false where an EKF is told the velocity, \
         which has the accelerometer's word already",
    ),
    (
        "keyframes",
        "true: a gyro's bias of 0.003 rad/s is 6 cm/s at 20 m, and frames a thirtieth of a second apart show next to nothing of it \
         (models/velocity.md)",
    ),
    (
        "accelerometer_sd_m_s2",
        "a MEMS accelerometer of 100 µg/√Hz has 0.02; the rest is what a soft mount leaves of the propellers",
    ),
    ("accelerometer_bias_sd_m_s2", "5 mg are left of a MEMS bias after a calibration on six sides"),
    ("inliers_min", "60 vectors give the three unknowns a margin of 40 equations each"),
    ("inlier_part_min", "where fewer than a quarter agree, another plane may be the larger one"),
    ("seed_rad", "one and a half pixels of the network's image at its usual field of view"),
    ("agree_rad_max", "beyond six such pixels nothing is noise, whatever the spread of the rest"),
    (
        "flow_shared_sd_cells",
        "0.002 network pixels: what residuals can't show, for the fit takes it for motion (cargo bench --bench velocity); \
         0.01 cells for vectors that [flow] refine = false leaves as the network gives them",
    ),
    ("flow_shared_sd_part", "the same bench, where the displacement is long; 0.005 without refining"),
    (
        "flow_bend_sd_cells",
        "0.008 network pixels: what texture, interpolation and things that stand on the ground leave in good light, where noise leaves next to \
         nothing (cargo bench --bench velocity, hovers)",
    ),
    (
        "ground_bend_sd",
        "a bulge of 5 cm a metre beside the image's middle: lawns and roads bend less, heaps and ditches more",
    ),
    (
        "ground_slope_sd",
        "roads fall by 2 to 2.5 % to the side, lawns and yards by 1 to 2 %; on a hillside a climb shows a gyro's bias that isn't there until it \
         ends, by as much of its speed as the slope is more",
    ),
    (
        "ground_relief_sd",
        "in the dark a box or a bush a few decimetres high passes for ground seen from ten metres (cargo bench --bench velocity, Exp-6)",
    ),
    ("clock_offset_s_max", "at 1 rad/s² it turns 2 mrad/s that nobody made; twice what gyro_offset_sd_s counts with"),
    (
        "turn_scale_off_max",
        "10 %: a hover that sways at 4 rad/s moves with its turns by as much at 6 m; a calibration that is off is more",
    ),
    ("seed", "any number: what counts is that it stays the same"),
];
