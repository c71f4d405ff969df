//! `[motion.obstacles]`: how far ahead is looked, and how sure one must be.

use serde::{Deserialize, Serialize};

/// `[motion.obstacles]`; without this table nothing is looked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// What is met later than this is not in the way.
    pub horizon_s: f64,
    /// Time constant of the filter in time: a change shows by two thirds after this long.
    pub delay_s: f64,
    /// Probability from which on a sector is said to be occupied or free; between, it is unknown.
    pub confidence_min: f64,
    /// What passes further below the camera's path than this is not in the way, metres.
    pub below_m: f64,
    /// What passes further above the camera's path than this is not in the way, metres.
    pub above_m: f64,
    /// Rays that are steeper against the path than this are left out where speed is not metric.
    pub elevation_rad_max: f64,
    /// Nothing is said of what is further away than this where speed is metric.
    pub reach_m_max: f64,
    /// A speed over ground that is not known any more holds for so long.
    pub speed_hold_s: f64,
    /// The fewest cells of the flow that make a surface.
    pub cells_min: usize,
    /// The least part of a sector's cells that make a surface.
    pub cells_part_min: f64,
    /// The least part of a sector's cells that must be seen before it may be free.
    pub seen_part_min: f64,
    /// A cell is seen where its texture shows a displacement to within this, in pixels of the network's image.
    pub texture_sd_px_max: f64,
    /// How many neighbouring cells stand for one independent vector.
    pub likeness_cells: f64,
    /// Error that all vectors of a step share, in pixels of the network's image.
    pub shared_px: f64,
    /// The direction of motion must be known to within this.
    pub heading_sd_rad_max: f64,
    /// A vector that leaves the lines through the focus of expansion by more standard deviations than this may be of
    /// something that moves, …
    pub mover_sds: f64,
    /// … and by more than this, in pixels of the network's image.
    pub mover_px_min: f64,
    /// The fewest connected cells that make something that moves.
    pub mover_cells_min: usize,
    /// Whether long thin things are looked for, which are narrower than a cell of the flow: wires, guys, rods.
    pub thin: bool,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            horizon_s: 8.0,
            delay_s: 0.15,
            confidence_min: 0.9,
            below_m: 1.0,
            above_m: 1.0,
            elevation_rad_max: 0.1,
            reach_m_max: 40.0,
            speed_hold_s: 1.0,
            cells_min: 5,
            cells_part_min: 0.04,
            seen_part_min: 0.5,
            texture_sd_px_max: 1.0,
            likeness_cells: 9.0,
            shared_px: 0.1,
            heading_sd_rad_max: 0.15,
            mover_sds: 4.0,
            mover_px_min: 0.5,
            mover_cells_min: 9,
            thin: true,
        }
    }
}

/// Why each default is what it is, by its key.
pub const REASONS: &[(&str, &str)] = &[
    ("obstacles.horizon_s", "8 s at 5 m/s is 40 m: what is later is not yet anybody's business, nor well seen"),
    ("obstacles.delay_s", "two steps at 15 Hz: single wild steps are damped, and 3 m/s makes half a metre of it"),
    ("obstacles.confidence_min", "a planner that brakes for nothing once in ten times is switched off"),
    ("obstacles.below_m", "a multicopter's half height, its sag when it brakes, and a margin"),
    ("obstacles.above_m", "the same upwards"),
    ("obstacles.elevation_rad_max", "6°: a metre above or below at ten metres"),
    ("obstacles.reach_m_max", "at 40 m a metre is 10 pixels of a 640-pixel camera, 1 cell of the flow"),
    (
        "obstacles.speed_hold_s",
        "near a wall no ground is seen; within a second a braking vehicle loses a few m/s, and then only times are told",
    ),
    ("obstacles.cells_min", "single cells are wild too often"),
    ("obstacles.cells_part_min", "a pole of a fifth of a degree in a sector of five"),
    ("obstacles.seen_part_min", "what hides in the unseen half may be in the way"),
    (
        "obstacles.texture_sd_px_max",
        "a pixel along the line through the focus of expansion: flow beyond is filled in from elsewhere; half of it leaves too little of a dark image",
    ),
    ("obstacles.likeness_cells", "networks' errors are smooth over about three cells along either side"),
    (
        "obstacles.shared_px",
        "what is left after refining in the dark (cargo bench --bench obstacles); without it, twice as much",
    ),
    ("obstacles.heading_sd_rad_max", "9°: beyond, the focus of expansion is anywhere in the middle of the image"),
    ("obstacles.mover_sds", "one of 16,000 vectors of what stands still, were they independent"),
    ("obstacles.mover_px_min", "half a pixel of the network's image is what rotation and calibration leave"),
    ("obstacles.mover_cells_min", "three by three: what a divergence can be fitted to"),
    ("obstacles.thin", "a wire is a pixel wide: what is seen around it would call it free"),
];

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_key_has_a_reason_and_no_reason_is_left_over() {
        let table = toml::Table::try_from(Config::default()).unwrap();
        let keys: BTreeSet<String> = table.keys().map(|key| format!("obstacles.{key}")).collect();
        assert_eq!(keys, REASONS.iter().map(|(key, _)| (*key).to_owned()).collect());
    }
}
