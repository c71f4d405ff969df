//! Brooks et al. 2019: a finished picture is led back to what the sensor saw, then noised.

use std::sync::LazyLock;

use super::{
    super::curves,
    Dice, Drawn,
    plan::{Camera, Clean, Grain, Plan, Spread},
};

/// From CIE XYZ to the colours of four cameras; the figures are those published with the paper
/// (google-research/unprocessing, Apache-2.0).
const XYZ_TO_CAMERA: [[[f64; 3]; 3]; 4] = [
    [[1.0234, -0.2969, -0.2266], [-0.5625, 1.6328, -0.0469], [-0.0703, 0.2188, 0.6406]],
    [[0.4913, -0.0541, -0.0202], [-0.613, 1.3513, 0.2906], [-0.1564, 0.2151, 0.7183]],
    [[0.838, -0.263, -0.0639], [-0.2887, 1.0725, 0.2496], [-0.0627, 0.1427, 0.5438]],
    [[0.6596, -0.2079, -0.0562], [-0.4782, 1.3016, 0.1933], [-0.097, 0.1581, 0.5181]],
];
/// From linear sRGB to CIE XYZ, white D65.
const RGB_TO_XYZ: [[f64; 3]; 3] = [
    [0.412_456_4, 0.357_576_1, 0.180_437_5],
    [0.212_672_9, 0.715_152_2, 0.072_175_0],
    [0.019_333_9, 0.119_192_0, 0.950_304_1],
];
const GAMMA: f64 = 2.2;

/// Tone curve and power undone, on the 8-bit scale.
static CURVE: LazyLock<[f32; 256]> = LazyLock::new(|| {
    let linear = |byte| 255.0 * curves::power(inverse_smoothstep(byte as f64 / 255.0), GAMMA);
    std::array::from_fn(|byte| linear(byte) as f32)
});

pub(super) fn plan(dice: &mut Dice, older: &[u8]) -> (Plan, Drawn) {
    let matrix = matrix(&XYZ_TO_CAMERA.map(|_| dice.between(1e-8, 1.0)));
    let brightness = 0.8 + 0.1 * dice.normal();
    let gain = [brightness / dice.between(1.9, 2.4), brightness, brightness / dice.between(1.5, 1.9)];
    let ln_a = dice.between(curves::ln(0.0001), curves::ln(0.012));
    let (a, b) = (curves::exp(ln_a), curves::exp(2.18 * ln_a + 1.20 + 0.26 * dice.normal()));
    let camera =
        Camera { matrix: matrix.map(|row| row.map(|value| value as f32)), gains: gain.map(|gain| gain as f32) };
    let clean = Clean { curves: [*CURVE; 3], camera: Some(camera) };
    let plan = Plan { clean, grain: Grain::Root, a: [(a * 255.0) as f32; 3], b: [(b * 255.0 * 255.0) as f32; 3] };
    let level = Spread::of(&plan.clean, older).level(|_, clean| a * clean + b);
    (plan, Drawn { a: [a; 3], b: [b; 3], gamma: [GAMMA; 3], gain, level: level * 255.0, taken: None })
}

/// From linear sRGB to the colours of a camera between the four: white stays white.
fn matrix(weights: &[f64; 4]) -> [[f64; 3]; 3] {
    let total: f64 = weights.iter().sum();
    let mut mixed = [[0.0; 3]; 3];
    for (row, colours) in mixed.iter_mut().enumerate() {
        for (column, value) in colours.iter_mut().enumerate() {
            for (camera, weight) in XYZ_TO_CAMERA.iter().zip(weights) {
                let product: f64 = (0..3).map(|i| camera[row][i] * RGB_TO_XYZ[i][column]).sum();
                *value += product * weight / total;
            }
        }
        let sum: f64 = colours.iter().sum();
        colours.iter_mut().for_each(|value| *value /= sum);
    }
    mixed
}

/// The x in 0…1 of 3x² − 2x³ = y. In closed form ½ − sin(arcsin(1 − 2y)/3); here by halving, which needs no library.
fn inverse_smoothstep(y: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..50 {
        let x = 0.5 * (low + high);
        if x * x * (3.0 - 2.0 * x) < y { low = x } else { high = x }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::{super::plan::STRIP, *};

    #[test]
    fn the_tone_curve_is_undone() {
        for byte in 0..=255 {
            let y = f64::from(byte) / 255.0;
            let closed = 0.5 - ((1.0 - 2.0 * y).asin() / 3.0).sin();
            // The curve is flat at its ends, where half of the digits are all there is.
            assert!((inverse_smoothstep(y) - closed).abs() < 1e-7, "{y}");
        }
    }

    #[test]
    fn white_stays_white_and_colours_mix() {
        for weights in [[1.0, 1e-8, 1e-8, 1e-8], [0.2, 0.9, 0.4, 0.1]] {
            let matrix = matrix(&weights);
            for row in matrix {
                assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            }
            // A camera's colours overlap: each keeps most of itself and takes from its neighbours.
            assert!((0..3).all(|i| matrix[i][i] > 0.4 && matrix[i][i] < 1.2), "{matrix:?}");
        }
    }

    #[test]
    fn colours_go_the_published_way() {
        let mut bytes = [0; STRIP];
        let pixels = bytes.as_chunks_mut::<3>().0;
        for (at, pixel) in pixels.iter_mut().enumerate() {
            // Every second pixel is near white, where the gains give way.
            *pixel = [at * 7, at * 13 + 80, at * 29 + 160]
                .map(|value| if at % 2 == 0 { value % 256 } else { 255 - value % 16 } as u8);
        }
        for pair in 0..5 {
            let (plan, drawn) = plan(&mut Dice::new(1, pair), &bytes);
            let matrix = plan.clean.camera.as_ref().unwrap().matrix.map(|row| row.map(f64::from));
            let mut means = [0.0; STRIP];
            plan.clean.means(&bytes, &mut means);
            for (pixel, found) in bytes.as_chunks::<3>().0.iter().zip(means.as_chunks::<3>().0) {
                let linear = pixel.map(|byte| {
                    let y = f64::from(byte) / 255.0;
                    (0.5 - ((1.0 - 2.0 * y).asin() / 3.0).sin()).powf(2.2)
                });
                let seen = matrix.map(|row| (0..3).map(|i| row[i] * linear[i]).sum::<f64>());
                let mask = ((seen.iter().sum::<f64>() / 3.0 - 0.9).max(0.0) / 0.1).powi(2);
                for colour in 0..3 {
                    let gain = (mask + (1.0 - mask) * drawn.gain[colour]).max(drawn.gain[colour]);
                    let expected = 255.0 * (seen[colour] * gain).clamp(0.0, 1.0);
                    assert!((f64::from(found[colour]) - expected).abs() < 2e-3, "{pixel:?}: {found:?}, {expected}");
                }
            }
        }
    }
}
