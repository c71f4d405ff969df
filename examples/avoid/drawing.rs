//! The flight as one SVG: the step at which the drone was stopped, what the node said of it, and the figures over time.

use std::{error::Error, f64::consts::TAU, fmt::Write, io::Cursor, path::Path};

use base64::{Engine, prelude::BASE64_STANDARD};
use image::{codecs::jpeg::JpegEncoder, imageops};
use nightflow::{motion::SECTORS, publish::shared::ObstaclesSample};
use plotters::{coord::Shift, prelude::*};

use super::simulation::{Flown, Settings, Step, Still};

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

const WIDE: u32 = 1200;
const RED: RGBColor = RGBColor(204, 51, 17);
const BLUE: RGBColor = RGBColor(0, 119, 187);
const GREEN: RGBColor = RGBColor(0, 153, 90);
const GREY: RGBColor = RGBColor(176, 176, 180);
/// The fan shows so much of the surroundings: the horizon of the flight, seconds.
const FAN_S: f64 = 3.0;

/// Draws the flight.
pub fn draw(path: &Path, settings: &Settings, flown: &Flown) -> Result<(), Box<dyn Error>> {
    let photo = flown.still.as_ref().map(photo).transpose()?;
    let top = photo.as_ref().map_or(0, |(_, tall)| *tall);
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (WIDE, top + 560)).into_drawing_area();
        root.fill(&WHITE)?;
        let (_, below) = root.split_vertically(top);
        let (curves, fan) = below.split_horizontally(if flown.still.is_some() { 740 } else { WIDE });
        let parts = curves.split_evenly((3, 1));
        let end = flown.steps.last().map_or(1.0, |step| step.seconds);
        let start = flown.steps.iter().filter_map(|step| step.left_m).fold(1.0, f64::max);
        chart(
            &parts[0],
            "distance to what is straight ahead, m",
            end,
            start,
            &[("true", BLACK, &|s| s.left_m)],
            flown,
        )?;
        chart(
            &parts[1],
            "speed, m/s",
            end,
            1.2 * settings.course.speed,
            &[("true", BLACK, &|s| Some(s.speed))],
            flown,
        )?;
        let times: [Curve; 2] = [("true", BLACK, &|s| s.true_s), ("said by the node", BLUE, &|s| s.said_s)];
        chart(&parts[2], "nearest time to contact ahead, s", end, start / settings.course.speed, &times, flown)?;
        if let Some(still) = &flown.still {
            draw_fan(&fan, still)?;
        }
        root.present()?;
    }
    if let (Some((jpeg, tall)), Some(at)) = (photo, svg.rfind("</svg>")) {
        let mut image = format!("<image width=\"{WIDE}\" height=\"{tall}\" href=\"data:image/jpeg;base64,");
        BASE64_STANDARD.encode_string(jpeg, &mut image);
        writeln!(image, "\"/>")?;
        svg.insert_str(at, &image);
    }
    Ok(std::fs::write(path, svg)?)
}

/// The still as a JPEG as wide as the drawing, and its height.
fn photo(still: &Still) -> Result<(Vec<u8>, u32), Box<dyn Error>> {
    let tall = still.picture.height() * WIDE / still.picture.width().max(1);
    let small = imageops::resize(&still.picture, WIDE, tall, imageops::FilterType::CatmullRom);
    let mut bytes = Cursor::new(Vec::new());
    JpegEncoder::new_with_quality(&mut bytes, 82).encode_image(&small)?;
    Ok((bytes.into_inner(), tall))
}

/// A line of a chart: its name, its colour, and its value at a step.
type Curve<'a> = (&'a str, RGBColor, &'a dyn Fn(&Step) -> Option<f64>);

fn chart(
    area: &Area<'_>,
    title: &str,
    end: f64,
    high: f64,
    curves: &[Curve<'_>],
    flown: &Flown,
) -> Result<(), Box<dyn Error>> {
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 16))
        .margin(6)
        .x_label_area_size(22)
        .y_label_area_size(40)
        .build_cartesian_2d(0.0..end, 0.0..high)?;
    chart.configure_mesh().y_labels(5).x_label_formatter(&|x| format!("{x:.1} s")).light_line_style(WHITE).draw()?;
    if let Some(still) = &flown.still {
        chart.draw_series([PathElement::new([(still.seconds, 0.0), (still.seconds, high)], RED.stroke_width(1))])?;
        let below = [Text::new(
            "told to stop",
            (still.seconds + 0.02 * end, 0.95 * high),
            ("sans-serif", 13).into_font().color(&RED),
        )];
        chart.draw_series(below)?;
    }
    for (name, colour, value) in curves {
        let colour = *colour;
        let mut named = false;
        // Where nothing is known there is no line.
        for run in flown.steps.chunk_by(|a, b| value(a).is_some() == value(b).is_some()) {
            let points: Vec<(f64, f64)> =
                run.iter().filter_map(|step| Some((step.seconds, value(step)?.clamp(0.0, high)))).collect();
            if points.is_empty() {
                continue;
            }
            let line = chart.draw_series(LineSeries::new(points, colour.stroke_width(2)).point_size(1))?;
            if !named && curves.len() > 1 {
                line.label(*name).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
            }
            named = true;
        }
    }
    if curves.len() > 1 {
        chart.configure_series_labels().position(SeriesLabelPosition::LowerLeft).border_style(GREY).draw()?;
    }
    Ok(())
}

/// The sectors from above, forward upwards; the rim is [`FAN_S`] seconds away.
fn draw_fan(area: &Area<'_>, still: &Still) -> Result<(), Box<dyn Error>> {
    let area = area.titled("what the node says there, seconds to contact", ("sans-serif", 16))?;
    let (wide, tall) = area.dim_in_pixel();
    let centre = (wide as i32 / 2, tall as i32 / 2 + 10);
    let rim = f64::from(wide.min(tall)) / 2.0 - 40.0;
    for sector in 0..SECTORS {
        let (reach, colour) = reach(&still.sample, sector);
        area.draw(&Polygon::new(wedge(centre, sector, rim * reach), colour.mix(0.75).filled()))?;
    }
    for seconds in 1..=FAN_S as i32 {
        let radius = rim * f64::from(seconds) / FAN_S;
        area.draw(&Circle::new(centre, radius as i32, BLACK.mix(0.25)))?;
        let place = (centre.0 + 3, centre.1 + radius as i32 - 14);
        area.draw(&Text::new(format!("{seconds} s"), place, ("sans-serif", 12)))?;
    }
    let names = [("occupied", RED), ("free", GREEN), ("unknown", GREY)];
    for (line, (name, colour)) in names.into_iter().enumerate() {
        let y = 30 + 18 * line as i32;
        area.draw(&Rectangle::new([(8, y), (22, y + 12)], colour.mix(0.75).filled()))?;
        area.draw(&Text::new(name, (28, y), ("sans-serif", 13)))?;
    }
    Ok(())
}

/// How far a sector is drawn, as a part of the rim, and in which colour.
fn reach(sample: &ObstaclesSample, sector: usize) -> (f64, RGBColor) {
    match sample.sector[sector] {
        2 => ((f64::from(sample.ttc_s[sector]) / FAN_S).clamp(0.05, 1.0), RED),
        1 => (1.0, GREEN),
        _ => (1.0, GREY),
    }
}

fn wedge(centre: (i32, i32), sector: usize, radius: f64) -> Vec<(i32, i32)> {
    let edge = |part: f64| {
        let bearing = TAU * (sector as f64 + part) / SECTORS as f64 - 0.5 * TAU;
        // Left is counter-clockwise: to the left of a picture whose top is forward.
        (centre.0 - (radius * bearing.sin()) as i32, centre.1 - (radius * bearing.cos()) as i32)
    };
    [-0.5, -0.25, 0.0, 0.25, 0.5].into_iter().map(edge).chain([centre]).collect()
}
