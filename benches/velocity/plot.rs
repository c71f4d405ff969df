//! Two curves of the default network: what quality is worth, and how honest the covariance is down the ladder.

use std::path::Path;

use nightflow::darkness::ladder::MEANS;
use plotters::prelude::*;

use super::tables::{self, BOUND, Row};

const SETS: [(&str, [usize; 2], RGBColor); 3] = [
    ("Exp-0…2", [0, 2], RGBColor(204, 51, 17)),
    ("Exp-3, Exp-4", [3, 4], RGBColor(0, 153, 90)),
    ("Exp-5, Exp-6", [5, 6], RGBColor(0, 119, 187)),
];

/// Draws both.
pub fn draw(path: &Path, rows: &[Row]) -> Result<(), Box<dyn std::error::Error>> {
    let root = SVGBackend::new(path, (960, 440)).into_drawing_area();
    root.fill(&WHITE)?;
    let (left, right) = root.split_horizontally(480);
    let mut chart = ChartBuilder::on(&left)
        .caption(format!("within {} m/s + {} % of the speed", BOUND[0], 100.0 * BOUND[1]), ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(0.0..1.0, 0.0..1.0)?;
    chart.configure_mesh().x_desc("quality / 255").y_desc("part of the steps").light_line_style(WHITE).draw()?;
    chart.draw_series(LineSeries::new([(0.0, 0.0), (1.0, 1.0)], BLACK.mix(0.4)))?;
    for (name, [first, last], colour) in SETS {
        let curve = tables::curve(rows, |row| (first..=last).contains(&row.rung));
        let bars = curve.iter().map(|(x, y, error, _)| PathElement::new([(*x, y - error), (*x, y + error)], colour));
        chart.draw_series(bars)?;
        chart
            .draw_series(
                LineSeries::new(curve.iter().map(|(x, y, ..)| (*x, *y)), colour.stroke_width(2)).point_size(3),
            )?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
    }
    chart.configure_series_labels().position(SeriesLabelPosition::LowerRight).border_style(BLACK.mix(0.3)).draw()?;
    let mut chart = ChartBuilder::on(&right)
        .caption("normalised error squared, linear velocity", ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(-0.5..MEANS.len() as f64 - 0.5, 0.0..2.0)?;
    chart
        .configure_mesh()
        .x_desc("Exp-")
        .y_desc("over its degrees of freedom")
        .x_labels(MEANS.len())
        .x_label_formatter(&|x| format!("{x:.0}"))
        .light_line_style(WHITE)
        .draw()?;
    let band = [(-0.5, 0.8), (MEANS.len() as f64 - 0.5, 1.25)];
    chart.draw_series([Rectangle::new(band, GREEN.mix(0.15).filled())])?;
    for rung in 0..MEANS.len() {
        let (mean, error) = tables::nees(rows, rung);
        let x = rung as f64;
        chart.draw_series([PathElement::new([(x, mean - error), (x, mean + error)], BLACK.stroke_width(2))])?;
        chart.draw_series([Circle::new((x, mean), 4, BLACK.filled())])?;
    }
    root.present()?;
    Ok(())
}
