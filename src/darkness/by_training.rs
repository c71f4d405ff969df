//! The paper's table on one's own data: networks by what they were trained on and what frames went through, by exposure.

use std::fmt::Write as _;

use plotters::{coord::Shift, prelude::*};

use super::{
    report::{DRAW, Record, Report},
    score::Spread,
};

/// What the last part of a network's name says that it was trained on.
pub const TRAINED: [(&str, &str); 6] = [
    ("clean", "clean"),
    ("fcdn", "FCDN, paper"),
    // What the three below it start from, each by a few steps more.
    ("start", "clean, short"),
    ("paper", "FCDN, paper, short"),
    ("authors2021", "FCDN, authors 2021"),
    ("unprocess", "unprocess"),
];

/// A row of the paper's table 2: network, training, what frames went through, end-point error at Exp-0 … Exp-6, px.
type Published = (&'static str, &'static str, &'static str, [f64; 7]);

/// Zheng, Zhang and Lu, "Optical Flow in the Dark", CVPR 2020, table 2: on VBOF, whose references are FlowNet2's.
pub const PUBLISHED: [Published; 10] = [
    ("FlowNetC", "FlyingChairs", "none", [5.78, 6.21, 6.98, 7.98, 9.48, 12.21, 14.73]),
    ("FlowNetC", "FCDN", "none", [5.76, 5.78, 5.78, 5.86, 5.98, 6.11, 6.55]),
    ("FlowNetS", "FlyingChairs", "none", [11.15, 11.34, 11.60, 11.57, 10.77, 10.09, 9.76]),
    ("FlowNetS", "FCDN", "none", [5.46, 5.53, 5.51, 5.53, 5.61, 5.67, 6.26]),
    ("PWC-Net", "FlyingChairs", "none", [7.13, 7.04, 7.08, 7.52, 7.58, 9.21, 10.88]),
    ("PWC-Net", "FCDN", "none", [5.31, 5.32, 5.29, 5.34, 5.37, 5.63, 6.09]),
    ("PWC-Net", "FlyingChairs", "NLM", [6.14, 6.15, 7.12, 7.12, 7.31, 8.59, 10.19]),
    ("PWC-Net", "FCDN", "NLM", [5.50, 5.57, 5.51, 5.50, 5.48, 5.57, 6.04]),
    ("PWC-Net", "FlyingChairs", "SID (Sony only)", [4.27, 4.41, 4.58, 4.99, 5.35, 5.58, 5.48]),
    ("PWC-Net", "FCDN", "SID (Sony only)", [4.31, 4.27, 4.25, 4.37, 4.30, 4.41, 4.60]),
];

/// End-point error of one method at one exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Mean over pairs and draws of the noise, px.
    pub mean: f64,
    /// Deviation of the draws' means, each over all pairs, px; not a number for a single draw.
    pub deviation: f64,
}

/// One network behind one enhancer.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Its name in the manifest.
    pub model: String,
    /// What frames went through.
    pub enhancer: String,
    /// At each condition of the report.
    pub cells: Vec<Option<Seen>>,
}

impl Row {
    /// The network's kind: its name up to what it was trained on.
    pub fn network(&self) -> &str {
        self.model.rsplit_once('_').map_or(&self.model, |(network, _)| network)
    }

    /// What it was trained on, as its name says.
    pub fn trained(&self) -> &str {
        let last = self.model.rsplit_once('_').map_or("", |(_, last)| last);
        TRAINED.iter().find(|(name, _)| *name == last).map_or(last, |(_, shown)| shown)
    }

    /// How much the error grows from the first condition to the last, %.
    pub fn lost(&self) -> Option<f64> {
        let [first, last] = [self.cells.first()?.as_ref()?, self.cells.last()?.as_ref()?];
        (first.mean > 0.0).then(|| 100.0 * (last.mean / first.mean - 1.0))
    }
}

/// The number of a record's draw.
fn draw_of(record: &Record) -> u32 {
    record.pair.rsplit_once(DRAW).and_then(|(_, draw)| draw.parse().ok()).unwrap_or(0)
}

fn seen(records: &[&Record]) -> Option<Seen> {
    let mut draws: Vec<u32> = records.iter().map(|record| draw_of(record)).collect();
    draws.sort_unstable();
    draws.dedup();
    let of = |draw: u32| {
        let here = records.iter().filter(|record| draw_of(record) == draw);
        let (count, sum) = here.fold((0, 0.0), |(count, sum), record| (count + 1, sum + record.epe));
        sum / f64::from(count)
    };
    let means: Vec<f64> = draws.into_iter().map(of).collect();
    let spread = Spread::of(&means)?;
    Some(Seen { mean: spread.mean, deviation: spread.error * (spread.count as f64).sqrt() })
}

/// A row for every network and enhancer, in the order in which they first came, networks together.
pub fn rows(report: &Report) -> Vec<Row> {
    let mut found: Vec<(&str, &str)> = vec![];
    for record in &report.records {
        if !found.contains(&(&record.model, &record.enhancer)) {
            found.push((&record.model, &record.enhancer));
        }
    }
    let models: Vec<&str> = found.iter().map(|(model, _)| *model).collect();
    found.sort_by_key(|(model, _)| models.iter().position(|known| known == model));
    let row = |(model, enhancer): (&str, &str)| {
        let here: Vec<&Record> =
            report.records.iter().filter(|record| record.model == model && record.enhancer == enhancer).collect();
        let at = |condition: &str| {
            let cell: Vec<&Record> = here.iter().copied().filter(|record| record.condition == condition).collect();
            seen(&cell)
        };
        let cells = report.conditions.iter().map(|(condition, _)| at(condition)).collect();
        Row { model: model.into(), enhancer: enhancer.into(), cells }
    };
    found.into_iter().map(row).collect()
}

fn heading(conditions: &[&str]) -> String {
    let columns = conditions.len() + 4;
    format!("| network | trained on | frames | {} | lost |\n|{}\n", conditions.join(" | "), " --- |".repeat(columns))
}

/// What frames went through, as the paper would call it.
fn called(enhancer: &str) -> String {
    match enhancer.split_once(':') {
        Some(("gaussian", sigma)) => format!("blur of {sigma} px"),
        _ => enhancer.replace("nlm", "NLM"),
    }
}

/// The table: mean ± deviation over the draws of the noise, px.
pub fn markdown(report: &Report) -> String {
    let conditions: Vec<&str> = report.conditions.iter().map(|(condition, _)| condition.as_str()).collect();
    let mut text = heading(&conditions);
    for row in rows(report) {
        let _ = write!(text, "| `{}` | {} | {} |", row.model, row.trained(), called(&row.enhancer));
        for cell in &row.cells {
            let _ = match cell {
                Some(Seen { mean, deviation }) if deviation.is_finite() => {
                    write!(text, " {mean:.2} ± {deviation:.2} |")
                }
                Some(Seen { mean, .. }) => write!(text, " {mean:.2} |"),
                None => write!(text, " – |"),
            };
        }
        // Nought has no sign but plus.
        let _ = writeln!(text, " {} |", row.lost().map_or("–".into(), |lost| format!("{:+.0} %", lost.round() + 0.0)));
    }
    text
}

/// The paper's own table in the same shape.
pub fn published() -> String {
    let conditions: Vec<String> = (0..7).map(|at| format!("Exp-{at}")).collect();
    let mut text = heading(&conditions.iter().map(String::as_str).collect::<Vec<_>>());
    for (network, trained, frames, errors) in PUBLISHED {
        let cells: Vec<String> = errors.iter().map(|error| format!("{error:.2}")).collect();
        let lost = 100.0 * (errors[6] / errors[0] - 1.0);
        let _ = writeln!(text, "| {network} | {trained} | {frames} | {} | {lost:+.0} % |", cells.join(" | "));
    }
    text
}

/// A panel for each network: end-point error by exposure, a colour for each training, a dash for each enhancer.
pub fn plot(report: &Report) -> Result<String, Box<dyn std::error::Error>> {
    let rows = rows(report);
    let mut networks: Vec<&str> = vec![];
    for row in &rows {
        if !networks.contains(&row.network()) {
            networks.push(row.network());
        }
    }
    let mut svg = String::new();
    {
        let size = (60 + 300 * (networks.len() as u32 + 1), 460);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        root.fill(&WHITE)?;
        let panels = root.split_evenly((1, networks.len() + 1));
        let means = rows.iter().flat_map(|row| &row.cells).flatten().map(|seen| seen.mean).filter(|mean| *mean > 0.0);
        let (low, high) = means.fold((f64::MAX, 0.0f64), |(low, high), mean| (low.min(mean), high.max(mean)));
        // One scale for all, so that networks can be compared; from nought the differences would not be seen.
        let range = if high > 0.0 { 0.9 * low..1.03 * high } else { 0.0..1.0 };
        for (network, panel) in networks.iter().zip(&panels) {
            let own: Vec<&Row> = rows.iter().filter(|row| row.network() == *network).collect();
            draw(panel, network, &own, report.conditions.len(), &range)?;
        }
        legend(&panels[networks.len()], &rows)?;
        root.present()?;
    }
    Ok(svg)
}

fn colour(row: &Row) -> RGBColor {
    match row.trained() {
        "clean" => RGBColor(204, 51, 17),
        "FCDN, paper" => RGBColor(0, 119, 187),
        "FCDN, authors 2021" => RGBColor(238, 119, 51),
        "unprocess" => RGBColor(0, 153, 136),
        "FCDN, paper, short" => RGBColor(51, 187, 238),
        _ => RGBColor(60, 60, 60),
    }
}

/// Length of a dash and of what follows it; a whole line has none.
fn dash(enhancer: &str) -> (i32, i32) {
    match enhancer.split(':').next() {
        Some("none") => (1, 0),
        Some("nlm") => (8, 4),
        _ => (2, 4),
    }
}

type Drawing = Result<(), Box<dyn std::error::Error>>;

fn draw(
    panel: &DrawingArea<SVGBackend<'_>, Shift>,
    network: &str,
    rows: &[&Row],
    conditions: usize,
    range: &std::ops::Range<f64>,
) -> Drawing {
    let last = (conditions as f64 - 1.0).max(1.0);
    let mut chart = ChartBuilder::on(panel)
        .caption(network, ("sans-serif", 16))
        .margin(8)
        .x_label_area_size(36)
        .y_label_area_size(44)
        .build_cartesian_2d(-0.2..last + 0.2, range.clone())?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_labels(conditions)
        .y_labels(8)
        .x_label_formatter(&|at| format!("{at:.0}"))
        .y_label_formatter(&|value| format!("{value:.1}"))
        .x_desc("Exp")
        .y_desc("end-point error, px")
        .draw()?;
    for row in rows {
        let cells = row.cells.iter().enumerate();
        let points: Vec<(f64, f64)> = cells.filter_map(|(at, seen)| Some((at as f64, seen.as_ref()?.mean))).collect();
        let style = colour(row).stroke_width(2);
        match dash(&row.enhancer) {
            (_, 0) => chart.draw_series(LineSeries::new(points, style))?,
            (length, gap) => chart.draw_series(DashedLineSeries::new(points, length, gap, style))?,
        };
    }
    Ok(())
}

fn legend(panel: &DrawingArea<SVGBackend<'_>, Shift>, rows: &[Row]) -> Drawing {
    let mut line = 40;
    let mut entry = |style: ShapeStyle, (length, gap): (i32, i32), name: &str| -> Drawing {
        let mut x = 20;
        while x < 60 {
            let end = if gap == 0 { 60 } else { (x + length).min(60) };
            panel.draw(&PathElement::new([(x, line), (end, line)], style))?;
            x = end + gap.max(1);
        }
        panel.draw(&Text::new(name.to_owned(), (70, line - 7), ("sans-serif", 14)))?;
        line += 24;
        Ok(())
    };
    let (mut trainings, mut enhancers): (Vec<&str>, Vec<&str>) = (vec![], vec![]);
    for row in rows {
        if !trainings.contains(&row.trained()) {
            trainings.push(row.trained());
            entry(colour(row).stroke_width(2), (1, 0), row.trained())?;
        }
    }
    for row in rows {
        if !enhancers.contains(&row.enhancer.as_str()) {
            enhancers.push(&row.enhancer);
            entry(BLACK.stroke_width(2), dash(&row.enhancer), &called(&row.enhancer))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(errors: &[(&str, &str, &str, &str, f64)]) -> Report {
        let record = |&(pair, condition, enhancer, model, epe): &(&str, &str, &str, &str, f64)| Record {
            pair: pair.into(),
            condition: condition.into(),
            fault: None,
            enhancer: enhancer.into(),
            model: model.into(),
            epe,
            fl_all: 0.0,
            aae: 0.0,
        };
        let conditions = ["Exp-0", "Exp-1"].map(|name| (name.to_owned(), name.to_owned())).to_vec();
        Report { conditions, records: errors.iter().map(record).collect(), ..Report::default() }
    }

    #[test]
    fn draws_are_averaged_over_pairs_and_then_compared() {
        let report = report(&[
            ("a", "Exp-0", "none", "pwcnet_clean", 1.0),
            ("b", "Exp-0", "none", "pwcnet_clean", 3.0),
            ("a~1", "Exp-0", "none", "pwcnet_clean", 2.0),
            ("b~1", "Exp-0", "none", "pwcnet_clean", 6.0),
            ("a", "Exp-1", "none", "pwcnet_clean", 6.0),
            ("a", "Exp-0", "nlm", "flownets_authors2021", 5.0),
            ("a", "Exp-0", "nlm", "pwcnet_clean", 7.0),
        ]);
        let rows = rows(&report);
        let names: Vec<(&str, &str)> = rows.iter().map(|row| (row.model.as_str(), row.enhancer.as_str())).collect();
        assert_eq!(names, [("pwcnet_clean", "none"), ("pwcnet_clean", "nlm"), ("flownets_authors2021", "nlm")]);
        // The draws' means are 2 and 4.
        let first = rows[0].cells[0].unwrap();
        assert!((first.mean - 3.0).abs() < 1e-12 && (first.deviation - 2.0f64.sqrt()).abs() < 1e-12, "{first:?}");
        assert!(rows[0].cells[1].unwrap().deviation.is_nan());
        assert_eq!((rows[0].lost(), rows[1].lost(), rows[1].cells[1]), (Some(100.0), None, None));
        assert_eq!((rows[2].network(), rows[2].trained()), ("flownets", "FCDN, authors 2021"));
        let text = markdown(&report);
        assert!(text.contains("| `pwcnet_clean` | clean | none | 3.00 ± 1.41 | 6.00 | +100 % |"), "{text}");
        let still = markdown(&self::report(&[
            ("a", "Exp-0", "none", "x_clean", 2.0),
            ("a", "Exp-1", "none", "x_clean", 1.995),
        ]));
        assert!(still.contains("| 2.00 | 2.00 | +0 % |") || still.contains("| 2.00 | 1.99 | +0 % |"), "{still}");
        assert!(text.contains("| `flownets_authors2021` | FCDN, authors 2021 | NLM | 5.00 | – | – |"), "{text}");
    }

    #[test]
    fn the_papers_table_has_its_shape() {
        let text = published();
        assert!(
            text.contains(
                "| PWC-Net | FlyingChairs | none | 7.13 | 7.04 | 7.08 | 7.52 | 7.58 | 9.21 | 10.88 | +53 % |"
            )
        );
        assert!(text.contains("| PWC-Net | FCDN | none | 5.31 | 5.32 | 5.29 | 5.34 | 5.37 | 5.63 | 6.09 | +15 % |"));
    }

    #[test]
    fn every_network_has_its_panel() {
        let svg =
            plot(&report(&[("a", "Exp-0", "none", "pwcnet_clean", 1.0), ("a", "Exp-1", "nlm", "flownetc_fcdn", 2.0)]))
                .unwrap();
        for part in ["pwcnet", "flownetc", "clean", "FCDN, paper", "NLM"] {
            assert!(svg.contains(part), "{part}");
        }
    }
}
