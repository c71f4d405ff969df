//! Flow as colour: the wheel of the Middlebury benchmark (Baker et al., "A Database and Evaluation Methodology for
//! Optical Flow", IJCV 2011), where the hue is the direction and the saturation is the length.

use std::f32::consts::PI;

/// How many of the wheel's 55 colours lie between two of its corners: red–yellow–green–cyan–blue–magenta–red.
const SEGMENTS: [(usize, [f32; 3], [f32; 3]); 6] = [
    (15, [255.0, 0.0, 0.0], [255.0, 255.0, 0.0]),
    (6, [255.0, 255.0, 0.0], [0.0, 255.0, 0.0]),
    (4, [0.0, 255.0, 0.0], [0.0, 255.0, 255.0]),
    (11, [0.0, 255.0, 255.0], [0.0, 0.0, 255.0]),
    (13, [0.0, 0.0, 255.0], [255.0, 0.0, 255.0]),
    (6, [255.0, 0.0, 255.0], [255.0, 0.0, 0.0]),
];

const COLOURS: usize = 55;

/// The wheel's colour number `index`, RGB 0…255.
fn corner(index: usize) -> [f32; 3] {
    let mut first = 0;
    for (count, from, to) in SEGMENTS {
        if index < first + count {
            let part = (index - first) as f32 / count as f32;
            return std::array::from_fn(|c| (from[c] + part * (to[c] - from[c])).floor());
        }
        first += count;
    }
    SEGMENTS[0].1
}

/// The colour of the vector (`u` right, `v` down), where a vector of length `longest` is fully saturated.
///
/// White is no motion; a vector longer than `longest` is darkened, as in the benchmark's own pictures; a vector that
/// is not finite is black.
pub fn colour(u: f32, v: f32, longest: f32) -> [u8; 3] {
    if !u.is_finite() || !v.is_finite() {
        return [0; 3];
    }
    let (u, v) = (u / longest.max(1e-6), v / longest.max(1e-6));
    let length = u.hypot(v);
    let place = ((-v).atan2(-u) / PI + 1.0) / 2.0 * (COLOURS - 1) as f32;
    let low = place.floor() as usize;
    let part = place - low as f32;
    let (from, to) = (corner(low % COLOURS), corner((low + 1) % COLOURS));
    std::array::from_fn(|c| {
        let full = ((1.0 - part) * from[c] + part * to[c]) / 255.0;
        let shade = if length <= 1.0 { 1.0 - length * (1.0 - full) } else { full * 0.75 };
        (255.0 * shade).floor() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_corners_of_the_wheel_are_where_the_benchmark_has_them() {
        // Values of the benchmark's own colour coding: right is red, left is cyan, still is white.
        assert_eq!(colour(0.0, 0.0, 1.0), [255, 255, 255]);
        assert_eq!(colour(1.0, 0.0, 1.0), [255, 0, 0]);
        let [r, g, b] = colour(-1.0, 0.0, 1.0);
        assert!(r < 30 && g > 180 && b > 220, "left is cyan to blue, not {r} {g} {b}");
        let [r, g, b] = colour(0.0, 1.0, 1.0);
        assert!(r > 230 && g > 200 && b < 20, "down is yellow, not {r} {g} {b}");
        assert_eq!(colour(f32::NAN, 0.0, 1.0), [0; 3]);
    }

    #[test]
    fn longer_than_the_longest_is_darkened() {
        assert_eq!(colour(2.0, 0.0, 1.0), [191, 0, 0]);
    }
}
