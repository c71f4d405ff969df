//! A bench as pictures: a bar each, and end-point error against milliseconds.

use anyhow::{Result, anyhow};
use plotters::prelude::*;

use super::{
    errors::CONDITIONS,
    report::{Point, Whose},
};

/// An error of the drawing library, which has no common type.
type Drawing = Result<(), Box<dyn std::error::Error>>;

/// Between two frames of a camera of 30 Hz.
const CAMERA_MS: f64 = 1e3 / 30.0;

fn drawn(
    size: (u32, u32),
    draw: impl FnOnce(&DrawingArea<SVGBackend<'_>, plotters::coord::Shift>) -> Drawing,
) -> Result<String> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let whole = root.fill(&WHITE).map_err(Into::into).and_then(|()| draw(&root));
        whole.and_then(|()| Ok(root.present()?)).map_err(|error| anyhow!("the picture can't be drawn: {error}"))?;
    }
    Ok(svg)
}

/// Milliseconds of a step, a bar each.
pub fn bars(points: &[Point]) -> Result<String> {
    let rows = points.len();
    drawn((960, 110 + 26 * rows as u32), |root| {
        let end = 1.08 * points.iter().map(|point| point.ms).fold(CAMERA_MS, f64::max);
        let mut chart = ChartBuilder::on(root)
            .caption("a step, ms; dashed: a camera's 30 Hz", ("sans-serif", 18))
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(250)
            // The first on top; half a row above and below.
            .build_cartesian_2d(0.0..end, (rows as f64 - 0.5)..-0.5)?;
        let name = |at: &f64| {
            let near = (at - at.round()).abs() < 1e-6 && *at >= 0.0;
            near.then(|| points.get(at.round() as usize)).flatten().map_or(String::new(), called)
        };
        let mesh = &mut chart.configure_mesh();
        let mesh = mesh.light_line_style(WHITE).disable_y_mesh().y_labels(2 * rows + 2).y_label_formatter(&name);
        mesh.x_label_formatter(&|ms| format!("{ms:.0}")).draw()?;
        let colour = |point: &Point| match point.whose {
            Whose::Ours => RGBColor(0, 119, 187),
            Whose::OpenVino => RGBColor(238, 119, 51),
            Whose::OpenCv => RGBColor(140, 140, 140),
        };
        chart.draw_series(points.iter().enumerate().map(|(row, point)| {
            let at = row as f64;
            Rectangle::new([(0.0, at - 0.35), (point.ms, at + 0.35)], colour(point).filled())
        }))?;
        chart.draw_series(points.iter().enumerate().map(|(row, point)| {
            Text::new(format!(" {:.1}", point.ms), (point.ms, row as f64 - 0.2), ("sans-serif", 13))
        }))?;
        let line = [(CAMERA_MS, -0.5), (CAMERA_MS, rows as f64 - 0.5)];
        chart.draw_series(DashedLineSeries::new(line, 6, 4, BLACK.stroke_width(1)))?;
        Ok(())
    })
}

/// End-point error against milliseconds: a colour for each network or method, squares for OpenVINO, hollow by day, filled in the
/// dark; nobody is below and left of the lines.
pub fn against(points: &[Point]) -> Result<String> {
    drawn((960, 560), |root| {
        let times = points.iter().map(|point| point.ms).chain([CAMERA_MS]);
        let (fast, slow) = times.fold((f64::MAX, 0.0f64), |(low, high), ms| (low.min(ms / 1.3), high.max(ms * 1.2)));
        let high = 1.1 * points.iter().flat_map(|point| point.epe).flatten().fold(1.0, f64::max);
        // The legend takes a third of the width, right of the slowest.
        let end = slow * (slow / fast).powf(0.5);
        let mut chart = ChartBuilder::on(root)
            .caption(
                format!("end-point error against time: {} hollow, {} filled", CONDITIONS[0], CONDITIONS[1]),
                ("sans-serif", 18),
            )
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(60)
            .build_cartesian_2d((fast..end).log_scale(), 0.0..high)?;
        let mesh = &mut chart.configure_mesh();
        let mesh = mesh.light_line_style(WHITE).x_labels(6).x_desc("ms a step").y_desc("px");
        mesh.x_label_formatter(&|ms| format!("{ms:.0}")).y_label_formatter(&|px| format!("{px:.1}")).draw()?;
        for condition in 0..CONDITIONS.len() {
            chart.draw_series(LineSeries::new(front(points, condition), BLACK.mix(0.35).stroke_width(1)))?;
        }
        // A network has its colour in whatever computes it.
        let mut names: Vec<&str> = vec![];
        points.iter().filter(|point| point.whose != Whose::OpenVino).for_each(|point| names.push(&point.name));
        for point in points {
            let place = names.iter().position(|name| *name == point.name).unwrap_or(0);
            let colour = Palette99::pick(place).to_rgba();
            let ends: Vec<(f64, f64)> = point.epe.iter().flatten().map(|epe| (point.ms, *epe)).collect();
            chart.draw_series(LineSeries::new(ends, colour.stroke_width(1)))?;
            let styles = [colour.stroke_width(2), colour.filled()];
            let marks = point.epe.iter().zip(styles).filter_map(|(epe, style)| Some(((point.ms, (*epe)?), style)));
            if point.whose == Whose::OpenVino {
                let square =
                    |at: (i32, i32), style| Rectangle::new([(at.0 - 4, at.1 - 4), (at.0 + 4, at.1 + 4)], style);
                let series =
                    chart.draw_series(marks.map(|(at, style)| EmptyElement::at(at) + square((0, 0), style)))?;
                series.label(called(point)).legend(move |(x, y)| square((x + 9, y), colour.filled()));
            } else {
                let series = chart.draw_series(marks.map(|(at, style)| Circle::new(at, 5, style)))?;
                series.label(called(point)).legend(move |(x, y)| Circle::new((x + 9, y), 5, colour.filled()));
            }
        }
        let line = [(CAMERA_MS, 0.0), (CAMERA_MS, high)];
        let series = chart.draw_series(DashedLineSeries::new(line, 6, 4, BLACK.stroke_width(1)))?;
        series.label("a camera's 30 Hz").legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], BLACK));
        chart.configure_series_labels().border_style(BLACK.mix(0.3)).background_style(WHITE.mix(0.8)).draw()?;
        Ok(())
    })
}

fn called(point: &Point) -> String {
    let by = if point.whose == Whose::OpenVino { ", OpenVINO fp32" } else { "" };
    format!("{}{by}", point.name)
}

/// Those that nobody beats in both, from the fastest on, joined by steps.
fn front(points: &[Point], condition: usize) -> Vec<(f64, f64)> {
    let mut known: Vec<(f64, f64)> =
        points.iter().filter_map(|point| point.epe[condition].map(|epe| (point.ms, epe))).collect();
    known.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut front: Vec<(f64, f64)> = vec![];
    for (ms, epe) in known {
        match front.last().map(|last| last.1) {
            Some(best) if epe >= best => {}
            Some(best) => front.extend([(ms, best), (ms, epe)]),
            None => front.push((ms, epe)),
        }
    }
    front
}
