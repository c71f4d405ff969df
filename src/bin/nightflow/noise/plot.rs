//! a against b on logarithmic axes, as in the paper's figure 4, with darktable's profiles behind what was measured.
//!
//! The few strokes are drawn by hand, once as SVG and once into a picture with the letters that the other pictures use:
//! a bitmap backend for plotters would bring a font renderer and ask for fonts on the machine.

use std::{fmt::Write, path::Path};

use anyhow::Result;
use image::{Rgb, RgbImage};
use nightflow::{darkness::profiles, publish::paint};

use super::{ending, report::Measured};

const SIZE: [f64; 2] = [820.0, 600.0];
/// Left, top, right and bottom of the axes.
const FRAME: [f64; 4] = [84.0, 56.0, 796.0, 536.0];
/// Powers of ten at either end, a and b.
const ENDS: [[f64; 2]; 2] = [[-6.5, -2.0], [-9.5, -3.5]];
const GREY: [u8; 3] = [150, 150, 156];
const GRID: [u8; 3] = [226, 226, 224];
const INK: [u8; 3] = [32, 32, 36];
/// Red, green and blue, in tones that tell apart on white.
const TONES: [[u8; 3]; 3] = [[204, 51, 17], [0, 138, 90], [0, 102, 187]];

/// Draws the plot; the name's ending says what as.
pub fn draw(path: &Path, measured: &[Measured]) -> Result<()> {
    if ending(path) == "png" {
        let [width, height] = SIZE.map(|side| side as u32);
        let mut canvas = RgbImage::from_pixel(width, height, paint::PAPER);
        compose(&mut canvas, measured);
        canvas.save(path)?;
    } else {
        let [width, height] = SIZE;
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" \
             height=\"{height}\" font-family=\"sans-serif\" font-size=\"14\">\n\
             <rect width=\"100%\" height=\"100%\" fill=\"#fafaf8\"/>\n"
        );
        compose(&mut svg, measured);
        std::fs::write(path, svg + "</svg>\n")?;
    }
    Ok(())
}

/// What a plot is made of.
trait Sheet {
    fn line(&mut self, from: [f64; 2], to: [f64; 2], colour: [u8; 3]);
    fn dot(&mut self, at: [f64; 2], radius: f64, colour: [u8; 3]);
    /// Text with its left end and its middle height at a point.
    fn text(&mut self, at: [f64; 2], text: &str);
}

impl Sheet for String {
    fn line(&mut self, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2], colour: [u8; 3]) {
        let stroke = hex(colour);
        let _ =
            writeln!(self, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{stroke}\"/>");
    }

    fn dot(&mut self, [x, y]: [f64; 2], radius: f64, colour: [u8; 3]) {
        let fill = hex(colour);
        let _ = writeln!(self, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{fill}\"/>");
    }

    fn text(&mut self, [x, y]: [f64; 2], text: &str) {
        let safe = text.replace('&', "&amp;").replace('<', "&lt;");
        let _ = writeln!(self, "<text x=\"{x:.1}\" y=\"{:.1}\" fill=\"{}\">{safe}</text>", y + 5.0, hex(INK));
    }
}

fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

impl Sheet for RgbImage {
    fn line(&mut self, from: [f64; 2], to: [f64; 2], colour: [u8; 3]) {
        let steps = (to[0] - from[0]).abs().max((to[1] - from[1]).abs()).ceil().max(1.0);
        for step in 0..=steps as u32 {
            let part = f64::from(step) / steps;
            let [x, y] = [0, 1].map(|i| from[i] + part * (to[i] - from[i]));
            dab(self, [x, y], colour, 1.0);
        }
    }

    fn dot(&mut self, at: [f64; 2], radius: f64, colour: [u8; 3]) {
        let reach = radius.ceil() as i32;
        for (dx, dy) in (-reach..=reach).flat_map(|dx| (-reach..=reach).map(move |dy| (dx, dy))) {
            let [x, y] = [at[0].round() + f64::from(dx), at[1].round() + f64::from(dy)];
            let cover = (radius + 0.5 - (x - at[0]).hypot(y - at[1])).clamp(0.0, 1.0);
            dab(self, [x, y], colour, cover);
        }
    }

    fn text(&mut self, [x, y]: [f64; 2], text: &str) {
        paint::write(self, x as u32, (y - 8.0).max(0.0) as u32, text);
    }
}

fn dab(canvas: &mut RgbImage, at: [f64; 2], colour: [u8; 3], cover: f64) {
    let [x, y] = at.map(|place| place.round().max(0.0) as u32);
    if x < canvas.width() && y < canvas.height() {
        let below = canvas.get_pixel(x, y).0;
        let mixed = std::array::from_fn(|c| (cover * f64::from(colour[c]) + (1.0 - cover) * f64::from(below[c])) as u8);
        canvas.put_pixel(x, y, Rgb(mixed));
    }
}

/// Where (a, b) stands; what is beyond the axes, stands on their ends.
fn place(a: f64, b: f64) -> [f64; 2] {
    let [left, top, right, bottom] = FRAME;
    let part = |value: f64, [low, high]: [f64; 2]| {
        let power = if value > 0.0 { value.log10() } else { low };
        (power.clamp(low, high) - low) / (high - low)
    };
    [left + part(a, ENDS[0]) * (right - left), bottom - part(b, ENDS[1]) * (bottom - top)]
}

fn compose(sheet: &mut impl Sheet, measured: &[Measured]) {
    axes(sheet);
    for profile in profiles::all() {
        for colour in 0..3 {
            sheet.dot(place(profile.noise.a[colour], profile.noise.b[colour]), 1.6, GREY);
        }
    }
    for colour in measured.iter().flat_map(|shot| &shot.colours) {
        let tone = TONES[match colour.name {
            "R" => 0,
            "B" => 2,
            _ => 1,
        }];
        let (a, b) = (colour.fit.a, colour.fit.b);
        let ([a_low, a_high], [b_low, b_high]) = (colour.fit.a_bounds(), colour.fit.b_bounds());
        sheet.line(place(a_low, b), place(a_high, b), tone);
        sheet.line(place(a, b_low), place(a, b_high), tone);
        sheet.dot(place(a, b), 4.5, tone);
    }
}

fn axes(sheet: &mut impl Sheet) {
    let [left, top, right, bottom] = FRAME;
    let powers = |[low, high]: [f64; 2]| (low.ceil() as i32..=high.floor() as i32).map(|power| 10_f64.powi(power));
    for a in powers(ENDS[0]) {
        let [x, _] = place(a, 1.0);
        sheet.line([x, top], [x, bottom], GRID);
        sheet.text([x - 18.0, bottom + 14.0], &format!("{a:e}"));
    }
    for b in powers(ENDS[1]) {
        let [_, y] = place(1.0, b);
        sheet.line([left, y], [right, y], GRID);
        sheet.text([left - 50.0, y], &format!("{b:e}"));
    }
    for (from, to) in [([left, top], [left, bottom]), ([left, bottom], [right, bottom])] {
        sheet.line(from, to, INK);
    }
    sheet.text([left, 18.0], "noise variance a y + b; b of nought or less stands on the axis");
    sheet.text([0.5 * (left + right) - 60.0, bottom + 40.0], "a, shot noise");
    sheet.text([8.0, top - 16.0], "b, read noise");
    let mut x = left + 170.0;
    for (name, tone) in [("red", TONES[0]), ("green", TONES[1]), ("blue", TONES[2]), ("darktable's profiles", GREY)] {
        sheet.dot([x, top - 16.0], 4.5, tone);
        sheet.text([x + 10.0, top - 16.0], name);
        x += 80.0;
    }
}
