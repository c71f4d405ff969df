//! Raw counts to a linear image: against a slow, plain reference, and everything that is promised of pairs and gains.

mod reference;
mod refusals;

use std::collections::BTreeSet;

use nightflow::{
    camera::Frame,
    clock::Stamp,
    exposure::{Config, Developer, Error, Exposed, REASONS},
    wire::{Header, Image, Time},
};
use proptest::prelude::*;
use reference::reference;

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

/// 12 bits in 16, black at 64.
fn twelve_bits() -> Config {
    Config { bit_depth: Some(12), black_level: Some(64.0), ..Config::default() }
}

/// A number that looks random.
fn scramble(x: u32, y: u32, seed: u32) -> u32 {
    let mut z = x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b) ^ seed.wrapping_mul(0xc2b2_ae35);
    z = (z ^ (z >> 16)).wrapping_mul(0x7feb_352d);
    z = (z ^ (z >> 15)).wrapping_mul(0x846c_a68b);
    z ^ (z >> 16)
}

/// Symmetric noise about 0, near to Gaussian, with a standard deviation of 9.2.
fn noise(x: u32, y: u32, seed: u32) -> i32 {
    let bits = scramble(x, y, seed);
    (0..4).map(|i| (bits >> (4 * i) & 15) as i32).sum::<i32>() - 30
}

/// A textured scene of noise over light that is `light` counts in the mean.
fn lit(light: f64, sec: i32) -> Frame {
    from_counts("bayer_rggb16", 96, 64, sec, |x, y| {
        let ground = light * if (x / 16 + y / 16) % 2 == 0 { 0.5 } else { 1.5 };
        (64.0 + ground + f64::from(noise(x, y, sec as u32)) * 0.1).round() as u16
    })
}

fn developed(config: &Config, frame: &Frame) -> Exposed {
    let mut developer = Developer::new(config).unwrap();
    developer.develop(frame).unwrap();
    developer.newest().unwrap().clone()
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|value| f64::from(*value)).sum::<f64>() / values.len() as f64
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, ..ProptestConfig::default() })]

    /// Every encoding, byte order, padding, depth and size, to the last places of the slow reference.
    #[test]
    fn equals_the_reference(scene in reference::scenes()) {
        let expected = reference(&scene);
        let mut developer = Developer::new(&scene.config).unwrap();
        let result = developer.develop(&scene.frame);
        // Dark noise around the black level may fall below it as a whole, in small frames: that is refused.
        let below = -expected.light - (1.0 / 256.0f64).max(1.0 / (scene.white - scene.black));
        if below > -1e-9 {
            prop_assert!(below < 1e-9 || matches!(result, Err(Error::BlackAboveMean { .. })), "{result:?}");
            return Ok(());
        }
        prop_assert!(result.is_ok(), "{result:?}");
        let developed = developer.newest().unwrap().clone();
        prop_assert_eq!([developed.width, developed.height], expected.size);
        prop_assert_eq!(developed.scale, expected.scale);
        prop_assert_eq!(&developed.saturated, &expected.saturated);
        prop_assert!((f64::from(developed.raw_mean) - expected.raw_mean).abs() < 1e-6);
        let gain = f64::from(developed.gain);
        // Every addition may round once, and area weights make as many as there are cells across and down a pixel.
        let rounding = f64::from(f32::EPSILON) / 2.0 * f64::from(8.0 + developed.scale[0] + developed.scale[1]);
        for (i, (ours, theirs)) in developed.rgb.iter().zip(&expected.reduced).enumerate() {
            let theirs = (theirs * gain).clamp(0.0, 1.0);
            let off = (f64::from(*ours) - theirs).abs();
            prop_assert!(off <= rounding * gain.max(1.0), "value {i}: {ours} against {theirs}");
        }
    }

    /// Area weights lose no light and make none: the mean does not depend on the size.
    #[test]
    fn reduction_keeps_the_sum(width in 2u32..120, height in 2u32..60, width_max in 1usize..60, seed: u32) {
        let frame = from_counts("mono16", width, height, 0, |x, y| (100 + scramble(x, y, seed) % 3000) as u16);
        let whole = developed(&Config { width_max: 16384, ..twelve_bits() }, &frame);
        let reduced = developed(&Config { width_max, ..twelve_bits() }, &frame);
        prop_assert!((whole.raw_mean - reduced.raw_mean).abs() <= 1e-6);
    }

    #[test]
    fn a_flat_image_stays_flat(width in 2u32..120, height in 2u32..60, width_max in 1usize..60, value in 70u16..4000) {
        for encoding in ["bayer_rggb16", "bayer_gbrg16", "mono16"] {
            let developed = developed(
                &Config { width_max, ..twelve_bits() },
                &from_counts(encoding, width, height, 0, |_, _| value),
            );
            let expected = f32::from(value - 64) / (4095.0 - 64.0);
            prop_assert!((developed.raw_mean / expected - 1.0).abs() < 1e-5);
            prop_assert!(developed.rgb.iter().all(|value| (value - 0.4).abs() < 1e-5));
        }
    }
}

#[test]
fn the_first_gain_brings_the_mean_to_the_target() {
    let frame = from_counts("bayer_grbg16", 64, 48, 0, |x, y| (100 + scramble(x, y, 1) % 200) as u16);
    let developed = developed(&twelve_bits(), &frame);
    assert!((mean(&developed.rgb) - 0.4).abs() < 1e-5, "{}", mean(&developed.rgb));
}

#[test]
fn twice_the_light_is_twice_the_mean_and_the_same_image() {
    let of = |times: u32| {
        let at = |x, y| (64 + times * (scramble(x, y, 5) % 400)) as u16;
        // Twice a count leaves the last bit zero, which is digital gain and no contradiction.
        developed(&twelve_bits(), &from_counts("bayer_bggr16", 80, 60, 0, at))
    };
    let (once, twice) = (of(1), of(2));
    assert_eq!(twice.raw_mean, 2.0 * once.raw_mean);
    assert_eq!(twice.gain, once.gain / 2.0);
    assert!(twice.rgb == once.rgb);
}

#[test]
fn noise_around_black_keeps_its_mean() {
    let at = |x, y| (64 + noise(x, y, 3)) as u16;
    let frame = from_counts("bayer_rggb16", 640, 480, 0, at);
    let counts = 640.0 * 480.0;
    let truth = (0..480).flat_map(|y| (0..640).map(move |x| noise(x, y, 3))).sum::<i32>() as f64 / counts;
    let developed = developed(&Config { width_max: 77, ..twelve_bits() }, &frame);
    let found = f64::from(developed.raw_mean) * (4095.0 - 64.0);
    // Colours weigh a third each and greens are twice as many, so the two means agree to their own scatter only.
    assert!(found.abs() < 4.0 * 9.2 / counts.sqrt() * 1.1, "mean {found}, of the pixels {truth}");
    assert!(developed.gain.is_finite() && developed.rgb.iter().all(|value| (0.0..=1.0).contains(value)));
}

#[test]
fn black_frames_get_the_largest_gain_and_stay_finite() {
    let mut developer = Developer::new(&twelve_bits()).unwrap();
    for sec in 0..3 {
        developer.develop(&from_counts("bayer_rggb16", 64, 48, sec, |_, _| 64)).unwrap();
    }
    let newest = developer.newest().unwrap();
    assert_eq!(newest.raw_mean, 0.0);
    assert!((newest.gain - 1000.0).abs() < 0.001);
    assert!(newest.rgb.iter().all(|value| *value == 0.0));
    assert_eq!(developer.pair().unwrap().gain_step, None);
}

#[test]
fn a_pair_shares_one_gain_and_keeps_it_under_flicker() {
    let mut developer = Developer::new(&twelve_bits()).unwrap();
    developer.develop(&lit(200.0, 0)).unwrap();
    assert!(developer.pair().is_none());
    let (gain, mut generation) = (developer.newest().unwrap().gain, developer.newest().unwrap().generation);
    for sec in 1..100 {
        let flicker = 1.0 + 0.05 * f64::from(sec % 7 - 3) / 3.0;
        developer.develop(&lit(200.0 * flicker, sec)).unwrap();
        let pair = developer.pair().unwrap();
        assert_eq!((pair.older.gain, pair.newer.gain, pair.gain_step), (gain, gain, None), "frame {sec}");
        // The older frame is bit for bit the newer one of the pair before, so its features can be kept.
        assert_eq!(pair.older.generation, generation);
        assert_ne!(pair.newer.generation, generation);
        generation = pair.newer.generation;
    }
}

#[test]
fn dusk_changes_both_frames_of_a_pair_alike() {
    let mut developer = Developer::new(&twelve_bits()).unwrap();
    let mut changes = 0;
    for sec in 0..120 {
        let light = 800.0 * 0.97f64.powi(sec);
        developer.develop(&lit(light, sec)).unwrap();
        let means = developer.newest().map(|newest| f64::from(newest.gain * newest.raw_mean)).unwrap();
        assert!((0.3..0.5).contains(&means), "frame {sec} stands at {means}");
        let Some(pair) = developer.pair() else { continue };
        assert_eq!(pair.older.gain, pair.newer.gain);
        assert_eq!(pair.gain_step, None);
        let fresh = developed(&twelve_bits(), &lit(800.0 * 0.97f64.powi(sec - 1), sec - 1));
        if (pair.older.gain - fresh.gain).abs() > 0.0 {
            changes += 1;
        }
        let ratio = pair.older.gain / fresh.gain;
        let same = pair.older.rgb.iter().zip(&fresh.rgb);
        assert!(same.filter(|(_, b)| **b < 0.8).all(|(a, b)| (a - b * ratio).abs() < 1e-5), "frame {sec}");
    }
    assert!(changes > 10);
}

#[test]
fn a_lamp_is_a_step_that_both_frames_survive() {
    for (before, after) in [(100.0, 300.0), (300.0, 100.0), (20.0, 1600.0), (1600.0, 20.0)] {
        let mut developer = Developer::new(&twelve_bits()).unwrap();
        developer.develop(&lit(before, 0)).unwrap();
        developer.develop(&lit(before, 1)).unwrap();
        assert_eq!(developer.pair().unwrap().gain_step, None);
        developer.develop(&lit(after, 2)).unwrap();
        let pair = developer.pair().unwrap();
        let factor = f64::from(pair.gain_step.unwrap());
        assert!((factor / (after / before) - 1.0).abs() < 0.01, "{factor}");
        assert_eq!(pair.older.gain, pair.newer.gain);
        let means = [pair.older, pair.newer].map(|exposed| exposed.gain * exposed.raw_mean);
        assert!(means[0].max(means[1]) <= 0.801, "neither may be clipped away: {means:?}");
        if (0.25..4.0).contains(&factor) {
            assert!((means[0] * means[1] - 0.16).abs() < 1e-4, "as far above as below: {means:?}");
        }
        let stepped = pair.older.generation;
        developer.develop(&lit(after, 3)).unwrap();
        let pair = developer.pair().unwrap();
        assert_eq!(pair.gain_step, None);
        assert!((pair.newer.gain * pair.newer.raw_mean - 0.4).abs() < 0.004);
        assert_ne!(pair.older.generation, stepped);
    }
}

#[test]
fn hot_pixels_go_and_lamps_stay() {
    for encoding in ["bayer_rggb16", "mono16"] {
        let clean = |x, y| (164 + noise(x, y, 9)) as u16;
        let hot = |x: u32, y: u32| x.is_multiple_of(37) && y.is_multiple_of(19) || (x, y) == (127, 95);
        let with_hot = from_counts(encoding, 128, 96, 0, |x, y| if hot(x, y) { 4095 } else { clean(x, y) });
        let whole = Config { width_max: 128, ..twelve_bits() };
        let found = developed(&whole, &with_hot);
        let truth = developed(&whole, &from_counts(encoding, 128, 96, 0, clean));
        assert_eq!(found.saturated_part, 0.0);
        // The median of eight neighbours scatters a little less than the pixel that it stands for.
        let span = 4095.0 - 64.0;
        for (a, b) in found.rgb.iter().zip(&truth.rgb) {
            assert!((a / found.gain - b / truth.gain).abs() * span < 5.5 * 9.2, "{encoding}: {a} {b}");
        }
        let unrepaired = developed(&Config { hot_threshold: 0.0, ..whole.clone() }, &with_hot);
        assert!(unrepaired.saturated_part > 0.0);

        // A lamp a pixel and a half wide, centred on a pixel: its neighbours are lit too.
        let lamp = |x: u32, y: u32| {
            let far = (f64::from(x) - 60.0).powi(2) + (f64::from(y) - 40.0).powi(2);
            (f64::from(clean(x, y)) + 3000.0 * (-far / (2.0 * 0.65 * 0.65)).exp()) as u16
        };
        let with_lamp = from_counts(encoding, 128, 96, 0, lamp);
        let kept = developed(&whole, &with_lamp);
        let untouched = developed(&Config { hot_threshold: 0.0, ..whole }, &with_lamp);
        assert!(kept.rgb == untouched.rgb, "{encoding}: the lamp was touched");
    }
}

#[test]
fn noise_alone_is_never_repaired() {
    for seed in 0..20 {
        let frame = from_counts("bayer_rggb16", 320, 240, 0, |x, y| (120 + noise(x, y, seed)) as u16);
        let repaired = developed(&twelve_bits(), &frame);
        let untouched = developed(&Config { hot_threshold: 0.0, ..twelve_bits() }, &frame);
        assert!(repaired.rgb == untouched.rgb, "seed {seed}");
    }
}

#[test]
fn a_frozen_camera_is_noticed() {
    let mut developer = Developer::new(&Config { width_max: 24, ..twelve_bits() }).unwrap();
    let mut frame = lit(100.0, 1);
    developer.develop(&frame).unwrap();
    assert!(!developer.newest().unwrap().frozen);
    // The same message twice is no new picture and proves nothing of the camera.
    developer.develop(&frame).unwrap();
    assert!(!developer.newest().unwrap().frozen);
    frame.image.header.stamp.sec = 2;
    developer.develop(&frame).unwrap();
    assert!(developer.newest().unwrap().frozen);
    // One bit of one pixel is enough, as is the exchange of two pixels that fall into one sum.
    let flip = |bytes: &mut Vec<u8>| bytes[5000] ^= 1;
    let exchange = |bytes: &mut Vec<u8>| {
        let pixel = (0..bytes.len()).step_by(8).find(|&i| bytes[i] != bytes[i + 4]).unwrap();
        bytes.swap(pixel, pixel + 4);
    };
    for change in [flip, exchange] {
        let before = developer.newest().unwrap().raw_mean;
        change(&mut frame.image.data);
        frame.image.header.stamp.sec += 1;
        developer.develop(&frame).unwrap();
        let newest = developer.newest().unwrap();
        assert!(!newest.frozen);
        assert!((newest.raw_mean - before).abs() < 1e-6);
    }
}

#[test]
fn a_bad_frame_spoils_itself_only() {
    let mut developer = Developer::new(&twelve_bits()).unwrap();
    for sec in 1..3 {
        developer.develop(&lit(100.0, sec)).unwrap();
    }
    let kept = developer.pair().map(|pair| (pair.older.clone(), pair.newer.clone())).unwrap();
    let mut short = lit(100.0, 3);
    short.image.data.pop();
    // The second is found out only after the whole frame was looked through.
    let too_deep = from_counts("bayer_rggb16", 96, 64, 3, |_, _| 0x1000);
    for bad in [short, too_deep] {
        developer.develop(&bad).unwrap_err();
        let pair = developer.pair().unwrap();
        for (before, after) in [(&kept.0, pair.older), (&kept.1, pair.newer)] {
            assert_eq!((before.stamp, before.generation), (after.stamp, after.generation));
            assert!(before.rgb == after.rgb && before.saturated == after.saturated);
        }
    }
    developer.develop(&lit(100.0, 4)).unwrap();
    let pair = developer.pair().unwrap();
    assert_eq!((pair.older.stamp.ns(), pair.newer.stamp.ns()), (2_000_000_000, 4_000_000_000));
}

#[test]
fn what_was_forgotten_and_what_is_unlike_finds_no_partner() {
    let mut developer = Developer::new(&twelve_bits()).unwrap();
    for sec in 1..3 {
        developer.develop(&lit(100.0, sec)).unwrap();
    }
    developer.forget();
    assert!(developer.pair().is_none() && developer.newest().is_none());
    developer.develop(&lit(900.0, 3)).unwrap();
    assert!(developer.pair().is_none());
    let newest = developer.newest().unwrap();
    assert!((newest.gain * newest.raw_mean - 0.4).abs() < 1e-6, "a frame alone takes its own gain");
    developer.develop(&from_counts("bayer_rggb16", 64, 48, 4, |x, y| (900 + scramble(x, y, 0) % 64) as u16)).unwrap();
    assert!(developer.pair().is_none());
    assert_eq!(developer.newest().map(|newest| (newest.width, newest.height)), Some((32, 24)));
}

/// The same bits on every machine: sums have a fixed order, and no operation differs between instruction sets.
#[test]
fn the_image_is_the_same_to_the_bit_everywhere() {
    let of = |width_max| {
        let mut developer = Developer::new(&Config { width_max, ..twelve_bits() }).unwrap();
        for sec in 0..4 {
            developer.develop(&lit(150.0 + 60.0 * f64::from(sec), sec)).unwrap();
        }
        let pair = developer.pair().unwrap();
        let values = [pair.older, pair.newer].into_iter().flat_map(|exposed| &exposed.rgb);
        let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
        xxhash_rust::xxh3::xxh3_64(&bytes)
    };
    insta::assert_snapshot!(format!("{:016x} {:016x}", of(24), of(31)), @"f38849bb63661fdf d790d31e3ce3e0cc");
}

#[test]
fn every_setting_has_its_reason() {
    let table = toml::Table::try_from(Config::default()).unwrap();
    // A setting that is unset is not written, so it does not show up by itself.
    let unset = ["bit_depth", "black_level", "white_level", "pattern", "packing", "width_min"];
    let settings: BTreeSet<&str> = table.keys().map(String::as_str).chain(unset).collect();
    let explained: BTreeSet<&str> = REASONS.iter().map(|(key, _)| *key).collect();
    assert_eq!(settings, explained);
    assert_eq!(REASONS.len(), explained.len());
    assert!(REASONS.iter().all(|(_, reason)| reason.len() > 10));
}

#[test]
fn settings_survive_their_file() {
    let written = "width_max = 256\nbit_depth = 10\njustification = \"high\"\nblack_level = 60\npattern = \"gbrg\"\n";
    let read: Config = toml::from_str(written).unwrap();
    assert_eq!((read.width_max, read.bit_depth, read.black_level), (256, Some(10), Some(60.0)));
    let again: Config = toml::from_str(&toml::to_string(&read).unwrap()).unwrap();
    assert_eq!(read, again);
    assert!(toml::from_str::<Config>("blacklevel = 60").unwrap_err().to_string().contains("black_level"));
}
