//! Raw counts to a linear image: against a slow, plain reference, and everything that is refused.

mod reference;

use nightflow::{
    camera::Frame,
    clock::Stamp,
    exposure::{Config, Developer, Exposed},
    wire::{Header, Image, Time},
};
use proptest::prelude::*;
use reference::{Scene, reference};

/// A frame of low-justified counts.
fn from_counts(encoding: &str, width: u32, height: u32, sec: i32, at: impl Fn(u32, u32) -> u16) -> Frame {
    let counts = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| at(x, y));
    let image = Image {
        header: Header { stamp: Time { sec, nanosec: 0 }, frame_id: "camera".into() },
        height,
        width,
        encoding: encoding.into(),
        is_bigendian: 0,
        step: width * 2,
        data: counts.flat_map(u16::to_le_bytes).collect(),
    };
    Frame { image, received: Stamp::default() }
}

fn twelve_bits() -> Config {
    Config { bit_depth: Some(12), ..Config::default() }
}

/// A fixed sequence of numbers that look random.
fn scramble(x: u32, y: u32, seed: u32) -> u32 {
    let mut z = x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b) ^ seed.wrapping_mul(0xc2b2_ae35);
    z = (z ^ (z >> 16)).wrapping_mul(0x7feb_352d);
    z = (z ^ (z >> 15)).wrapping_mul(0x846c_a68b);
    z ^ (z >> 16)
}

fn developed(config: &Config, frame: &Frame) -> Exposed {
    let mut developer = Developer::new(config).unwrap();
    developer.develop(frame).unwrap();
    developer.newest().unwrap().clone()
}

fn close(a: f32, b: f32, tolerance: f32) -> bool {
    (a - b).abs() <= tolerance * b.abs().max(1e-3)
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|value| f64::from(*value)).sum::<f64>() / values.len() as f64
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    /// Every encoding, byte order, padding, depth and size, to the last place of the slow reference.
    #[test]
    fn equals_the_reference(scene in reference::scenes()) {
        let Scene { frame, config, .. } = &scene;
        let mut developer = Developer::new(config).unwrap();
        developer.develop(frame).unwrap();
        let developed = developer.newest().unwrap();
        let expected = reference(&scene);
        prop_assert_eq!([developed.width, developed.height], expected.size);
        prop_assert_eq!(developed.scale, expected.scale);
        prop_assert_eq!(&developed.saturated, &expected.saturated);
        prop_assert!(close(developed.raw_mean, expected.raw_mean as f32, 1e-4), "{} {}", developed.raw_mean, expected.raw_mean);
        for (i, (ours, theirs)) in developed.rgb.iter().zip(&expected.reduced).enumerate() {
            let theirs = (theirs * f64::from(developed.gain)).clamp(0.0, 1.0) as f32;
            prop_assert!((ours - theirs).abs() <= 2e-6 * developed.gain.max(1.0), "value {i}: {ours} against {theirs}");
        }
    }
}

#[test]
fn mean_is_at_the_target_after_the_first_gain() {
    let frame = from_counts("bayer_grbg16", 64, 48, 0, |x, y| (100 + scramble(x, y, 1) % 200) as u16);
    let developed = developed(&Config { black_level: Some(64.0), ..twelve_bits() }, &frame);
    assert!((mean(&developed.rgb) - 0.4).abs() < 1e-5, "{}", mean(&developed.rgb));
}
