//! What the developer refuses, and in which words.

use insta::assert_snapshot;
use nightflow::exposure::{Config, Developer, Error, Justification, Packing, Pattern};

use super::{from_counts, lit, scramble, twelve_bits};

fn settings(config: Config) -> Error {
    Developer::new(&config).unwrap_err()
}

fn refused(config: &Config, frame: nightflow::camera::Frame) -> Error {
    Developer::new(config).unwrap().develop(&frame).unwrap_err()
}

fn with(change: impl Fn(&mut nightflow::wire::Image)) -> nightflow::camera::Frame {
    let mut frame = lit(100.0, 1);
    change(&mut frame.image);
    frame
}

#[test]
fn settings_without_sense() {
    let base = Config::default;
    assert_snapshot!(settings(Config { width_max: 0, ..base() }), @"exposure.width_max: expected 1 to 16384, found 0");
    assert_snapshot!(settings(Config { mean_target: f32::NAN, ..base() }), @"exposure.mean_target: expected 0.01 to 0.99, found NaN");
    assert_snapshot!(settings(Config { gain_smoothing: 0.0, ..base() }), @"exposure.gain_smoothing: expected 0.001 to 1, found 0");
    assert_snapshot!(settings(Config { bit_depth: Some(11), ..base() }), @"exposure.bit_depth: expected 8, 10, 12, 14 or 16, found 11");
    assert_snapshot!(settings(Config { bit_depth: Some(12), packing: Some(Packing::Raw10), ..base() }), @r#"exposure.packing = "raw10" has 10 bits a pixel, but exposure.bit_depth = 12 is set"#);
    assert_snapshot!(
        settings(Config { justification: Justification::High, packing: Some(Packing::Raw12), ..base() }),
        @r#"exposure.justification = "high" is for 16-bit containers, but raw12 has no spare bits: set it to "low""#
    );
}

#[test]
fn messages_at_odds_with_the_settings() {
    let frame = |encoding: &str| with(|image| image.encoding = encoding.into());
    assert_snapshot!(refused(&twelve_bits(), frame("rgb8")), @r#"encoding: expected bayer_{rggb,bggr,gbrg,grbg}{8,16}, mono8, mono16, 16UC1 or 8UC1, found "rgb8""#);
    assert_snapshot!(refused(&twelve_bits(), frame("bayer_rgbg8")), @r#"encoding: expected bayer_{rggb,bggr,gbrg,grbg}{8,16}, mono8, mono16, 16UC1 or 8UC1, found "bayer_rgbg8""#);
    let bggr = Config { pattern: Some(Pattern::Bggr), ..twelve_bits() };
    assert_snapshot!(refused(&bggr, frame("bayer_rggb16")), @r#"the image says bayer_rggb16, but exposure.pattern = "bggr" is set: one of them is wrong"#);
    assert_snapshot!(refused(&bggr, frame("mono16")), @r#"the image says mono16, but exposure.pattern = "bggr" is set: one of them is wrong"#);
    assert_snapshot!(refused(&Config { packing: Some(Packing::Raw10), ..Config::default() }, frame("bayer_rggb8")), @r#"exposure.packing = "raw10" needs the encoding 8UC1, found bayer_rggb8"#);
    assert_snapshot!(refused(&twelve_bits(), frame("mono8")), @"exposure.bit_depth = 12 is set, but mono8 holds 8 bits a pixel");
    assert_snapshot!(refused(&Config { justification: Justification::High, ..Config::default() }, frame("8UC1")), @r#"exposure.justification = "high" is for 16-bit containers, but 8UC1 has no spare bits: set it to "low""#);
    assert_snapshot!(refused(&Config { black_level: Some(5000.0), ..twelve_bits() }, frame("mono16")), @"expected 0 <= black level < white level <= 4095, found black 5000 and white 4095");
    assert_snapshot!(refused(&Config { white_level: Some(5000.0), ..twelve_bits() }, frame("mono16")), @"expected 0 <= black level < white level <= 4095, found black 64 and white 5000");
}

#[test]
fn sizes_that_do_not_hold() {
    let config = twelve_bits();
    assert_snapshot!(refused(&config, with(|image| image.width = 0)), @"size: expected at least 2x2 pixels for bayer_rggb16, found 0x64");
    assert_snapshot!(refused(&config, with(|image| image.height = 1)), @"size: expected at least 2x2 pixels for bayer_rggb16, found 96x1");
    assert_snapshot!(refused(&config, with(|image| image.step = 191)), @"step: a row of 96 pixels as bayer_rggb16 takes 192 bytes, found a step of 191");
    assert_snapshot!(refused(&config, with(|image| image.data.truncate(100))), @"data: expected 12288 bytes for 64 rows of 192, found 100");
    assert_snapshot!(refused(&config, with(|image| (image.height, image.step) = (u32::MAX, u32::MAX))), @"data: expected 18446744065119617025 bytes for 4294967295 rows of 4294967295, found 12288");
    assert_snapshot!(refused(&config, with(|image| image.width = u32::MAX)), @"step: a row of 4294967295 pixels as bayer_rggb16 takes 8589934590 bytes, found a step of 192");
    let packed = Config { packing: Some(Packing::Raw10), ..Config::default() };
    let raw10 = with(|image| (image.encoding, image.width, image.step) = ("8UC1".into(), 200, 160));
    assert_snapshot!(refused(&packed, raw10), @"step: a row of 200 pixels as 8UC1 takes 250 bytes, found a step of 160");
}

#[test]
fn counts_at_odds_with_the_settings() {
    let rich = |x, y| (64 + scramble(x, y, 7) % 1024) as u16;
    let frame = |shift: u32| from_counts("bayer_rggb16", 64, 48, 0, |x, y| rich(x, y) << shift);
    assert_snapshot!(refused(&Config { bit_depth: Some(10), ..Config::default() }, frame(0)), @r#"bit_depth 10 with justification "low" allows counts up to 1023, but the frame holds 1087: the depth is larger, or the justification is "high""#);
    let high = Config { justification: Justification::High, ..twelve_bits() };
    assert_snapshot!(refused(&high, frame(3)), @r#"bit_depth 12 with justification "high" leaves the low 4 bits zero, but the frame sets bits 0x8 there: the depth is larger, or the justification is "low""#);
    assert_snapshot!(refused(&Config::default(), frame(4)), @r#"bit_depth 16 with justification "low" is declared, but the low 4 bits of all 3072 non-zero pixels are zero: it looks like bit_depth = 12 with justification = "high""#);
    // So dark that high-justified counts still fit the declared depth.
    let dark = from_counts("bayer_rggb16", 64, 48, 0, |x, y| ((70 + scramble(x, y, 7) % 100) << 4) as u16);
    assert_snapshot!(refused(&twelve_bits(), dark.clone()), @r#"bit_depth 12 with justification "low" is declared, but the low 4 bits of all 3072 non-zero pixels are zero: it looks like bit_depth = 12 with justification = "high""#);
    Developer::new(&high).unwrap().develop(&dark).unwrap();
    assert_snapshot!(refused(&Config { white_level: Some(800.0), ..twelve_bits() }, frame(0)), @"white level 800 is declared, but the frame holds counts of 1087: white level or bit_depth is wrong");
    assert_snapshot!(refused(&Config { black_level: Some(700.0), ..twelve_bits() }, frame(0)), @"black level 700 is declared, but the frame's mean is 575.8: the black level is too high");
}

/// Neither is a contradiction: pixels differ in where they are full, and black levels drift.
#[test]
fn what_is_only_inexact_is_taken() {
    let frame = from_counts("bayer_rggb16", 64, 48, 0, |x, y| (500 + scramble(x, y, 7) % 524) as u16);
    let mut developer = Developer::new(&Config { white_level: Some(1000.0), ..twelve_bits() }).unwrap();
    developer.develop(&frame).unwrap();
    assert!(developer.newest().unwrap().saturated_part > 0.1);
    let dark = from_counts("bayer_rggb16", 64, 48, 0, |x, y| (50 + scramble(x, y, 7) % 21) as u16);
    let mut developer = Developer::new(&twelve_bits()).unwrap();
    developer.develop(&dark).unwrap();
    assert!(developer.newest().unwrap().raw_mean < 0.0);
}

/// Some drivers count bytes in the width of packed images, others pixels.
#[test]
fn packed_rows_may_be_counted_in_bytes() {
    let counts: Vec<u16> = (0..40 * 6).map(|i| (scramble(i, 0, 3) % 1024) as u16).collect();
    let (step, bytes) = super::reference::lay(&counts, 40, super::reference::Bytes::Raw10, 0, 0);
    let config = Config { packing: Some(Packing::Raw10), pattern: Some(Pattern::Grbg), ..Config::default() };
    let of = |width: u32| {
        let frame = with(|image| {
            (image.encoding, image.width, image.height) = ("8UC1".into(), width, 6);
            (image.step, image.data) = (step as u32, bytes.clone());
        });
        super::developed(&config, &frame)
    };
    let (pixels, in_bytes) = (of(40), of(50));
    assert_eq!((pixels.width, pixels.height), (20, 3));
    assert!(pixels.rgb == in_bytes.rgb);
}
