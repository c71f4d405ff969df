//! Detection rate against false alarms, course by course, one curve an exposure.

use std::path::Path;

use nightflow::darkness::ladder::MEANS;
use plotters::prelude::*;

use super::score::{self, Row, SURE};

/// From light to dark.
const COLOURS: [RGBColor; MEANS.len()] = [
    RGBColor(221, 170, 51),
    RGBColor(238, 119, 51),
    RGBColor(204, 51, 17),
    RGBColor(170, 51, 119),
    RGBColor(51, 51, 170),
    RGBColor(0, 119, 187),
    RGBColor(60, 60, 60),
];
/// False alarms are drawn on a logarithm; none at all stands at its left end.
const LEAST: f64 = 1e-4;

/// Draws the first method with the first settings.
pub fn draw(path: &Path, rows: &[Row], courses: &[String]) -> Result<(), Box<dyn std::error::Error>> {
    let columns = courses.len().min(2);
    let lines = courses.len().div_ceil(2);
    let root = SVGBackend::new(path, (480 * columns as u32, 400 * lines as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    for (area, course) in root.split_evenly((lines, columns)).iter().zip(courses) {
        let mut chart = ChartBuilder::on(area)
            .caption(course, ("sans-serif", 18))
            .margin(10)
            .x_label_area_size(36)
            .y_label_area_size(48)
            .build_cartesian_2d((LEAST..1.0).log_scale(), 0.0..1.0)?;
        chart
            .configure_mesh()
            .x_desc("false alarms: part of the clear sectors (left end: none)")
            .y_desc("part of what is met in 1–5 s that is seen")
            .x_label_formatter(&|x| format!("{x:.0e}"))
            .light_line_style(WHITE)
            .draw()?;
        for (rung, colour) in COLOURS.into_iter().enumerate() {
            let of = || {
                let ours = |row: &&Row| row.course == *course && (row.method, row.variant) == (0, 0);
                rows.iter().filter(ours).filter(move |row| row.rung == rung)
            };
            if of().next().is_none() {
                continue;
            }
            let at = |sure: f64| {
                let rates = score::rates(of(), sure);
                (rates.alarmed.max(LEAST), rates.detected)
            };
            let bounds = (0..=40).map(|k| 1.0 - 0.5 * 0.75_f64.powi(40 - k));
            let curve: Vec<(f64, f64)> = bounds.map(at).collect();
            chart
                .draw_series(LineSeries::new(curve, colour.stroke_width(2)))?
                .label(format!("Exp-{rung}"))
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
            chart.draw_series([Circle::new(at(SURE), 4, colour.filled())])?;
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .border_style(BLACK.mix(0.3))
            .draw()?;
    }
    root.present()?;
    Ok(())
}
