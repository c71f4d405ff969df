//! What pictures of flow are painted with: text, the colour wheel with its length, scales, and frames as a screen shows
//! them.

use image::{Rgb, RgbImage};
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};

use crate::{exposure::Exposed, flow::wheel};

/// The ground of every picture.
pub const PAPER: Rgb<u8> = Rgb([250, 250, 248]);
/// The colour of text and lines.
pub const INK: Rgb<u8> = Rgb([32, 32, 36]);
/// What is not known.
pub const UNKNOWN: [u8; 3] = [176, 176, 180];
/// Height of a line of text with its leading, pixels.
pub const LINE: u32 = 24;
/// Height of the letters.
const LETTER: u32 = 16;

/// Dark violet over green to yellow (after matplotlib's viridis, CC0): reads well in grey too.
const CONFIDENCE: [[u8; 3]; 5] = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
/// Black over red to a pale yellow (after matplotlib's inferno, CC0).
const ERROR: [[u8; 3]; 5] = [[0, 0, 4], [87, 16, 110], [188, 55, 84], [249, 142, 9], [252, 255, 164]];

/// The colour of a confidence of 0…1.
pub fn confidence(value: f32) -> [u8; 3] {
    ramp(&CONFIDENCE, value)
}

/// The colour of an error, where 1 is the longest that the scale shows.
pub fn error(part: f32) -> [u8; 3] {
    ramp(&ERROR, part)
}

fn ramp(stops: &[[u8; 3]; 5], value: f32) -> [u8; 3] {
    if value.is_nan() {
        return UNKNOWN;
    }
    let place = value.clamp(0.0, 1.0) * 4.0;
    let low = (place as usize).min(3);
    let part = place - low as f32;
    std::array::from_fn(|c| {
        let (from, to) = (f32::from(stops[low][c]), f32::from(stops[low + 1][c]));
        (from + part * (to - from)).round() as u8
    })
}

/// A linear pixel of a developed frame as a screen shows it (gamma 2.2), `times` brighter.
pub fn display(image: &Exposed, column: usize, row: usize, times: f32) -> [u8; 3] {
    let plane = image.width * image.height;
    std::array::from_fn(|c| {
        let linear = (image.rgb[c * plane + row * image.width + column] * times).clamp(0.0, 1.0);
        (linear.powf(1.0 / 2.2) * 255.0).round() as u8
    })
}

/// The next of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8 and their multiples by ten that is not less: a scale that can be read.
pub fn round_up(length: f32) -> f32 {
    let ten = 10_f32.powf(length.max(1e-3).log10().floor());
    let steps = [1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0];
    steps.into_iter().map(|step| step * ten).find(|step| *step >= length * 0.9999).unwrap_or(10.0 * ten)
}

/// How wide a line of text is, pixels.
pub fn width(text: &str) -> u32 {
    text.chars().count() as u32 * get_raster_width(FontWeight::Regular, RasterHeight::Size16) as u32
}

/// One line of text, its top left corner at (`left`, `top`); what does not fit is cut, and a letter that the font
/// lacks is left blank.
pub fn write(canvas: &mut RgbImage, left: u32, top: u32, text: &str) {
    let advance = get_raster_width(FontWeight::Regular, RasterHeight::Size16) as u32;
    for (index, letter) in text.chars().enumerate() {
        let Some(raster) = get_raster(letter, FontWeight::Regular, RasterHeight::Size16) else { continue };
        for (y, line) in raster.rows().enumerate() {
            for (x, shade) in line.iter().enumerate() {
                let (column, row) = (left + index as u32 * advance + x as u32, top + y as u32);
                if *shade > 0 && column < canvas.width() && row < canvas.height() {
                    let part = f32::from(*shade) / 255.0;
                    let below = canvas.get_pixel(column, row).0;
                    let mixed = std::array::from_fn(|c| {
                        (part * f32::from(INK.0[c]) + (1.0 - part) * f32::from(below[c])) as u8
                    });
                    canvas.put_pixel(column, row, Rgb(mixed));
                }
            }
        }
    }
}

/// The colour wheel in a square of `side` pixels: its rim stands for the longest vector.
pub fn wheel(canvas: &mut RgbImage, left: u32, top: u32, side: u32) {
    let radius = side as f32 / 2.0;
    for y in 0..side {
        for x in 0..side {
            let (u, v) = ((x as f32 + 0.5 - radius) / radius, (y as f32 + 0.5 - radius) / radius);
            if u.hypot(v) <= 1.0 {
                canvas.put_pixel(left + x, top + y, Rgb(wheel::colour(u, v, 1.0)));
            }
        }
    }
}

/// A horizontal scale of `wide` pixels with its two ends written below it.
pub fn scale(canvas: &mut RgbImage, place: [u32; 2], wide: u32, colour: fn(f32) -> [u8; 3], ends: [&str; 2]) {
    let [left, top] = place;
    for x in 0..wide {
        for y in 0..LETTER {
            canvas.put_pixel(left + x, top + y, Rgb(colour(x as f32 / (wide - 1).max(1) as f32)));
        }
    }
    write(canvas, left, top + LETTER + 2, ends[0]);
    write(canvas, (left + wide).saturating_sub(width(ends[1])), top + LETTER + 2, ends[1]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_begin_and_end_where_they_say() {
        assert_eq!((confidence(0.0), confidence(1.0)), (CONFIDENCE[0], CONFIDENCE[4]));
        assert_eq!((error(-1.0), error(9.0)), (ERROR[0], ERROR[4]));
        assert_eq!(error(f32::NAN), UNKNOWN);
        assert_eq!(confidence(0.5), CONFIDENCE[2]);
    }

    #[test]
    fn a_length_is_rounded_up_to_one_that_can_be_read() {
        let rounded = [0.13, 1.0, 1.2, 4.0, 6.5, 9.0, 42.0].map(round_up);
        for (found, expected) in rounded.into_iter().zip([0.15, 1.0, 1.2, 4.0, 8.0, 10.0, 50.0]) {
            assert!((found - expected).abs() < 1e-4, "{found} is not {expected}");
        }
    }
}
