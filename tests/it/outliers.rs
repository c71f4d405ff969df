//! What is not the ground: velocity holds among cars, propellers, sky and lamps, whose vectors are as sure as any.

use nalgebra::{UnitQuaternion, Vector3};
use nightflow::{
    darkness::noise::Normals,
    motion::{Lack, Mount},
};

use crate::motion::{GRID, Seen, Truth};

/// A flight with network-like noise on every vector.
fn flight(camera: Mount) -> (Truth, Seen, Normals) {
    let mut truth = Truth::hovering(5.0);
    truth.config.camera = camera;
    truth.velocity = Vector3::new(2.0, 0.4, -0.1);
    truth.attitude = UnitQuaternion::from_euler_angles(0.03, -0.05, 0.3);
    let mut seen = truth.exact();
    let mut draws = Normals::new(3, 0);
    seen.vectors.iter_mut().for_each(|value| *value += (0.3 * draws.draw()) as f32);
    (truth, seen, draws)
}

/// Writes vectors over the cells of a window of the raster (columns, rows).
fn cover(seen: &mut Seen, columns: [usize; 2], rows: [usize; 2], mut vector: impl FnMut() -> [f64; 2]) {
    for row in rows[0]..rows[1] {
        for column in columns[0]..columns[1] {
            let cell = row * GRID.width + column;
            let [u, v] = vector();
            (seen.vectors[2 * cell], seen.vectors[2 * cell + 1]) = (u as f32, v as f32);
            seen.confidence[cell] = 0.95;
        }
    }
}

fn off(truth: &Truth, seen: &Seen) -> f64 {
    let found = truth.velocity(seen, true).unwrap();
    (Vector3::from(found.linear) - truth.expected()).norm()
}

#[test]
fn a_car_that_fills_a_third_of_the_image_is_left_out() {
    let (truth, mut seen, mut draws) = flight(Mount::Downward);
    let before = off(&truth, &seen);
    // It drives past at some metres a second: one motion of its own, smooth and sure.
    cover(&mut seen, [10, 50], [12, 52], || [-9.0 + 0.3 * draws.draw(), 14.0 + 0.3 * draws.draw()]);
    let after = off(&truth, &seen);
    assert!(before < 0.03 && after < 0.04, "{before} and {after} m/s off");
}

#[test]
fn propellers_in_the_corners_are_left_out() {
    let (truth, mut seen, mut draws) = flight(Mount::Downward);
    for (columns, rows) in [([0, 16], [0, 12]), ([64, 80], [0, 12]), ([0, 16], [48, 60]), ([64, 80], [48, 60])] {
        cover(&mut seen, columns, rows, || [30.0 * (draws.uniform() - 0.5), 30.0 * (draws.uniform() - 0.5)]);
    }
    let after = off(&truth, &seen);
    assert!(after < 0.04, "{after} m/s off");
    // Blades that stand still in the image, as a shutter in step with them shows them, are no ground that stands still.
    for (columns, rows) in [([0, 20], [0, 14]), ([60, 80], [0, 14])] {
        cover(&mut seen, columns, rows, || [0.05 * draws.draw(), 0.05 * draws.draw()]);
    }
    let after = off(&truth, &seen);
    assert!(after < 0.04, "{after} m/s off");
}

#[test]
fn the_sky_over_a_camera_that_looks_ahead_is_left_out() {
    let (truth, mut seen, mut draws) = flight(Mount::Forward);
    let ground = seen.confidence.iter().filter(|confidence| **confidence > 0.0).count();
    assert!((GRID.cells() / 4..GRID.cells() * 3 / 4).contains(&ground), "{ground} cells show ground");
    for cell in 0..GRID.cells() {
        if seen.confidence[cell] == 0.0 {
            // Far clouds do not move, and the network is sure of them.
            seen.vectors[2 * cell] = (0.1 * draws.draw()) as f32;
            seen.vectors[2 * cell + 1] = (0.1 * draws.draw()) as f32;
            seen.confidence[cell] = 0.95;
        }
    }
    let after = off(&truth, &seen);
    assert!(after < 0.1, "{after} m/s off");
}

#[test]
fn lamps_that_are_carried_along_are_left_out() {
    // The vehicle's own lamp lights a round patch that moves with it, and its glare hides what is below.
    let (truth, mut seen, mut draws) = flight(Mount::Downward);
    cover(&mut seen, [28, 52], [18, 42], || [0.2 * draws.draw(), 0.2 * draws.draw()]);
    let after = off(&truth, &seen);
    assert!(after < 0.04, "{after} m/s off");
}

#[test]
fn where_nothing_but_movers_is_seen_nothing_is_said() {
    let (truth, mut seen, mut draws) = flight(Mount::Downward);
    cover(&mut seen, [0, GRID.width], [0, GRID.height], || {
        [30.0 * (draws.uniform() - 0.5), 30.0 * (draws.uniform() - 0.5)]
    });
    let said = truth.velocity(&seen, true).unwrap_err();
    assert!(matches!(said, Lack::Disagreement { .. }), "{said:?}");
}
