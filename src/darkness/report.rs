//! What an evaluation found, as Markdown, CSV, JSON and a picture.

use std::{collections::BTreeMap, fmt::Write as _};

use plotters::prelude::*;
use serde::Serialize;

use super::{
    bound::Limit,
    datasets::{self, Skipped},
    faults::Fault,
    score::{Score, Spread},
};

/// One method on one pair.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Record {
    /// The pair.
    pub pair: String,
    /// The exposure, the pass, or `all`.
    pub condition: String,
    /// What noise was there besides the camera's; nothing where several kinds aren't compared.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault: Option<Fault>,
    /// What the frames went through.
    pub enhancer: String,
    /// The method.
    pub model: String,
    /// Mean end-point error, px.
    pub epe: f64,
    /// Part of outliers, 0…1.
    pub fl_all: f64,
    /// Mean angular error, degrees.
    pub aae: f64,
}

impl Record {
    /// A score with what it is of.
    pub fn new(pair: &str, condition: &str, enhancer: &str, model: &str, score: Score) -> Self {
        let Score { epe, fl_all, aae } = score;
        let [pair, condition, enhancer, model] = [pair, condition, enhancer, model].map(str::to_owned);
        Self { pair, condition, fault: None, enhancer, model, epe, fl_all, aae }
    }

    fn method(&self) -> String {
        if self.enhancer == "none" { self.model.clone() } else { format!("{} + {}", self.enhancer, self.model) }
    }
}

/// Everything that is known after an evaluation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Report {
    /// What was run on what: lines of the header.
    pub about: Vec<(String, String)>,
    /// Conditions in their order, and how each is shown.
    pub conditions: Vec<(String, String)>,
    /// Kinds of noise in their order where they are compared; limits and the tables of all measures are of the first.
    pub faults: Vec<Fault>,
    /// Scores.
    pub records: Vec<Record>,
    /// The Cramér–Rao bound: pair, condition, bound.
    pub limits: Vec<(String, String, Limit)>,
    /// What was left out.
    pub skipped: Vec<Skipped>,
}

/// What a figure is of: the condition, the kind of noise where they are compared, the method.
type Cell<'a> = (&'a str, Option<Fault>, &'a str);

/// A measure: its title, its value in a record, and decimals.
type Measure = (&'static str, fn(&Record) -> f64, usize);

const MEASURES: [Measure; 3] = [
    ("End-point error, px", |record| record.epe, 2),
    ("Outliers (Fl-all: above 3 px and above 5 %), %", |record| 100.0 * record.fl_all, 1),
    ("Angular error, degrees", |record| record.aae, 1),
];

impl Report {
    /// Takes note of a condition and of how it is shown; `exposure 2` stands before `exposure 10`.
    pub fn knows(&mut self, condition: (String, String)) {
        if !self.conditions.iter().any(|(known, _)| *known == condition.0) {
            self.conditions.push(condition);
            self.conditions.sort_by_key(|known| natural(&known.0));
        }
    }

    /// Methods in the order in which they first came.
    fn methods(&self) -> Vec<String> {
        let mut methods: Vec<String> = vec![];
        for method in self.records.iter().map(Record::method) {
            if !methods.contains(&method) {
                methods.push(method);
            }
        }
        methods
    }

    /// What a measure says in each pair.
    fn measured(&self, cell: Cell<'_>, measure: fn(&Record) -> f64) -> BTreeMap<&str, f64> {
        let (condition, fault, method) = cell;
        let here = self.records.iter().filter(|record| record.condition == condition && record.fault == fault);
        let here = here.filter(|record| record.method() == method);
        by_pair(here.map(|record| (record.pair.as_str(), measure(record))))
    }

    fn spread(&self, cell: Cell<'_>, measure: fn(&Record) -> f64) -> Option<Spread> {
        Spread::of(&self.measured(cell, measure).into_values().collect::<Vec<_>>())
    }

    /// The kinds of noise, of which there is one without a name where none are compared.
    fn kinds(&self) -> Vec<Option<Fault>> {
        if self.faults.is_empty() { vec![None] } else { self.faults.iter().copied().map(Some).collect() }
    }

    fn limit(&self, condition: &str, of: fn(&Limit) -> f64) -> Option<Spread> {
        let here = self.limits.iter().filter(|limit| limit.1 == condition);
        let limits = by_pair(here.map(|limit| (limit.0.as_str(), of(&limit.2))));
        Spread::of(&limits.into_values().collect::<Vec<_>>())
    }

    /// Tables for reading: the three measures, and how far above the bound each method is.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        for (what, value) in &self.about {
            let _ = writeln!(text, "- {what}: {value}");
        }
        let (methods, first) = (self.methods(), self.faults.first().copied());
        let noise = first.map_or(String::new(), |fault| format!(", noise: {fault}"));
        for (title, measure, decimals) in MEASURES {
            let limit = decimals == 2 && !self.limits.is_empty();
            let _ = writeln!(text, "\n### {title}{noise} (mean ± standard error over pairs [pairs])\n");
            self.heading(&mut text, &methods, if limit { &["limit, mean", "limit, median"] } else { &[] });
            for (condition, shown) in &self.conditions {
                let _ = write!(text, "| {shown} |");
                for method in &methods {
                    let _ = write!(text, " {} |", cell(self.spread((condition, first, method), measure), decimals));
                }
                if limit {
                    for of in [|limit: &Limit| limit.epe, |limit: &Limit| limit.median] {
                        let _ = write!(text, " {} |", cell(self.limit(condition, of), 3));
                    }
                }
                text.push('\n');
            }
        }
        if !self.limits.is_empty() {
            let _ = writeln!(text, "\n### How far above the limit: mean end-point error over mean limit{noise}\n");
            self.heading(&mut text, &methods, &[]);
            for (condition, shown) in &self.conditions {
                let limit = self.limit(condition, |limit| limit.epe).map(|limit| limit.mean);
                let _ = write!(text, "| {shown} |");
                for method in &methods {
                    let mean = self.spread((condition, first, method), |record| record.epe).map(|spread| spread.mean);
                    match (mean, limit) {
                        (Some(mean), Some(limit)) if limit > 0.0 => {
                            let _ = write!(text, " ×{:.1} |", mean / limit);
                        }
                        _ => text.push_str(" – |"),
                    }
                }
                text.push('\n');
            }
        }
        if !self.faults.is_empty() {
            self.by_fault(&mut text, &methods);
        }
        text += &datasets::left_out(&self.skipped);
        text
    }

    /// A table a method: how end-point error moves with the kind of noise.
    fn by_fault(&self, text: &mut String, methods: &[String]) {
        let conditions: Vec<String> = self.conditions.iter().map(|(condition, _)| condition.clone()).collect();
        let against = self.faults.iter().copied().find(|fault| *fault == Fault::None);
        for method in methods {
            let change = if against.is_some() { "; change against none of the same pairs" } else { "" };
            let _ = writeln!(text, "\n### {method} by noise: end-point error, px{change}\n");
            self.heading(text, &conditions, &[]);
            for fault in &self.faults {
                let _ = write!(text, "| {fault} |");
                for condition in &conditions {
                    let of = |fault| self.measured((condition, Some(fault), method), |record| record.epe);
                    let here = of(*fault);
                    let _ = write!(text, " {}", cell(Spread::of(&here.values().copied().collect::<Vec<_>>()), 2));
                    let none = against.filter(|none| none != fault).map(of);
                    if let Some(Spread { mean, error, .. }) = none.and_then(|none| change_of(&here, &none)) {
                        // Nought has no sign but plus.
                        let _ = write!(text, ", {:+.1}", (10.0 * mean).round() / 10.0 + 0.0);
                        if error.is_finite() {
                            let _ = write!(text, " ± {error:.1}");
                        }
                        text.push_str(" %");
                    }
                    text.push_str(" |");
                }
                text.push('\n');
            }
        }
    }

    fn heading(&self, text: &mut String, methods: &[String], more: &[&str]) {
        let columns: Vec<&str> = methods.iter().map(String::as_str).chain(more.iter().copied()).collect();
        let _ = writeln!(text, "| | {} |\n|{}", columns.join(" | "), " --- |".repeat(columns.len() + 1));
    }

    /// The mean table, one line a cell; with a column for the kind of noise where they are compared.
    pub fn csv(&self) -> String {
        let mut text = String::from("condition,");
        text.push_str(if self.faults.is_empty() { "" } else { "fault," });
        text.push_str("method,pairs,epe,epe_error,fl_all,aae,limit_epe,limit_rms,limit_median\n");
        for (condition, _) in &self.conditions {
            let limits = [|limit: &Limit| limit.epe, |limit: &Limit| limit.rms, |limit: &Limit| limit.median]
                .map(|of| self.limit(condition, of).map_or(String::new(), |spread| format!("{:.5}", spread.mean)));
            for fault in self.kinds() {
                let kind = fault.map_or(String::new(), |fault| format!("{fault},"));
                for method in self.methods() {
                    let [epe, fl, aae] =
                        MEASURES.map(|(_, measure, _)| self.spread((condition, fault, &method), measure));
                    if let (Some(epe), Some(fl), Some(aae)) = (epe, fl, aae) {
                        let error = if epe.error.is_finite() { format!("{:.5}", epe.error) } else { String::new() };
                        let _ = writeln!(
                            text,
                            "{},{kind}{},{},{:.5},{error},{:.5},{:.5},{}",
                            quoted(condition),
                            quoted(&method),
                            epe.count,
                            epe.mean,
                            fl.mean / 100.0,
                            aae.mean,
                            limits.join(",")
                        );
                    }
                }
            }
        }
        text
    }

    /// Every single figure.
    pub fn json(&self) -> Result<String, serde_json::Error> {
        let limits: Vec<_> = self
            .limits
            .iter()
            .map(|(pair, condition, limit)| {
                serde_json::json!({"pair": pair, "condition": condition, "epe": limit.epe, "rms": limit.rms,
                    "median": limit.median})
            })
            .collect();
        let skipped: Vec<_> =
            self.skipped.iter().map(|left| serde_json::json!({"what": left.what, "why": left.why})).collect();
        let about: serde_json::Map<_, _> =
            self.about.iter().map(|(what, value)| (what.clone(), value.clone().into())).collect();
        let conditions: Vec<&String> = self.conditions.iter().map(|(condition, _)| condition).collect();
        serde_json::to_string_pretty(&serde_json::json!({
            "about": about, "conditions": conditions, "records": self.records, "limits": limits, "skipped": skipped,
        }))
    }

    /// End-point error against the condition, a line a method with a bar of one standard error; the bound is dashed.
    pub fn plot(&self) -> Result<String, Box<dyn std::error::Error>> {
        let mut svg = String::new();
        {
            let root = SVGBackend::with_string(&mut svg, (960, 560)).into_drawing_area();
            root.fill(&WHITE)?;
            self.draw(&root)?;
            root.present()?;
        }
        Ok(svg)
    }

    fn draw(
        &self,
        root: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let methods = self.methods();
        let first = self.faults.first().copied();
        let epe = |condition: &str, method: &str| self.spread((condition, first, method), |record| record.epe);
        let line = |of: &dyn Fn(&str) -> Option<Spread>| -> Vec<(f64, Spread)> {
            let shown = self.conditions.iter().enumerate();
            shown.filter_map(|(at, (condition, _))| Some((at as f64, of(condition)?))).collect()
        };
        let lines: Vec<_> = methods.iter().map(|method| line(&|condition| epe(condition, method))).collect();
        let limit = line(&|condition| self.limit(condition, |limit| limit.epe));
        let means = lines.iter().chain([&limit]).flatten().map(|(_, spread)| spread.mean).filter(|mean| *mean > 0.0);
        let (low, high) = means.fold((f64::MAX, 0.0f64), |(low, high), mean| (low.min(mean), high.max(mean)));
        let (low, high) = if high > 0.0 { (low / 1.4, high * 1.4) } else { (0.1, 10.0) };
        let last = (self.conditions.len() as f64 - 1.0).max(1.0);
        let mut chart = ChartBuilder::on(root)
            .caption("end-point error, mean over pairs and one standard error", ("sans-serif", 18))
            .margin(10)
            .x_label_area_size(40)
            .y_label_area_size(60)
            // The legend takes a quarter of the width, right of the last condition.
            .build_cartesian_2d(-0.2..(last + 0.5) / 0.75, (low..high).log_scale())?;
        let label = |at: &f64| {
            let near = (at - at.round()).abs() < 1e-6 && *at >= 0.0;
            near.then(|| self.conditions.get(at.round() as usize))
                .flatten()
                .map_or(String::new(), |(name, _)| name.clone())
        };
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .x_labels(2 * self.conditions.len() + 4)
            .x_label_formatter(&label)
            .y_label_formatter(&|value| format!("{value:.2}"))
            .y_desc("px")
            .draw()?;
        for (at, (name, points)) in methods.iter().zip(&lines).enumerate() {
            let colour = Palette99::pick(at).to_rgba();
            let drawn = points.iter().map(|(x, spread)| (*x, spread.mean));
            let series = chart.draw_series(LineSeries::new(drawn, colour.stroke_width(2)).point_size(3))?;
            series.label(name).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
            let bars = points.iter().filter(|(_, spread)| spread.error.is_finite()).map(|(x, spread)| {
                let ends = [spread.mean - spread.error, spread.mean + spread.error].map(|end| end.clamp(low, high));
                PathElement::new([(*x, ends[0]), (*x, ends[1])], colour.stroke_width(1))
            });
            chart.draw_series(bars)?;
        }
        if !limit.is_empty() {
            let drawn = limit.iter().map(|(x, spread)| (*x, spread.mean));
            let series = chart.draw_series(DashedLineSeries::new(drawn, 6, 4, BLACK.stroke_width(2)))?;
            series.label("limit").legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], BLACK.stroke_width(2)));
        }
        chart.configure_series_labels().border_style(BLACK.mix(0.3)).background_style(WHITE.mix(0.8)).draw()?;
        Ok(())
    }
}

/// Letters, then the number at the end.
fn natural(name: &str) -> (String, u64) {
    let letters = name.trim_end_matches(|letter: char| letter.is_ascii_digit());
    (letters.to_owned(), name[letters.len()..].parse().unwrap_or(0))
}

/// Stands between a pair's name and the number of the draw of its noise.
pub const DRAW: char = '~';

/// A value a pair; several draws of one pair's noise are no further pairs, they are averaged.
fn by_pair<'a>(values: impl Iterator<Item = (&'a str, f64)>) -> BTreeMap<&'a str, f64> {
    let mut pairs: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for (name, value) in values {
        pairs.entry(name.split(DRAW).next().unwrap_or(name)).or_default().push(value);
    }
    pairs.into_iter().map(|(pair, draws)| (pair, draws.iter().sum::<f64>() / draws.len() as f64)).collect()
}

/// By how many percent the mean over the pairs that both know has changed, and the standard error of that, in which
/// what makes one pair harder than another has no part.
fn change_of(now: &BTreeMap<&str, f64>, before: &BTreeMap<&str, f64>) -> Option<Spread> {
    let both: Vec<[f64; 2]> = now.iter().filter_map(|(pair, now)| Some([*now, *before.get(pair)?])).collect();
    let mean = |of: usize| both.iter().map(|pair| pair[of]).sum::<f64>() / both.len() as f64;
    let (after, base) = (mean(0), mean(1));
    // The error of a ratio of two means, to first order: of each pair's distance from the common ratio.
    let ratio = after / base;
    let apart: Vec<f64> = both.iter().map(|[now, before]| 100.0 * (now - ratio * before) / base).collect();
    let spread = Spread::of(&apart).filter(|_| base > 0.0)?;
    Some(Spread { mean: 100.0 * (ratio - 1.0), ..spread })
}

/// `1.59 ± 0.33 [9]`; a single pair has no error.
fn cell(spread: Option<Spread>, decimals: usize) -> String {
    match spread {
        None => "– [0]".into(),
        Some(Spread { mean, error, count }) if error.is_finite() => {
            format!("{mean:.decimals$} ± {error:.decimals$} [{count}]")
        }
        Some(Spread { mean, count, .. }) => format!("{mean:.decimals$} [{count}]"),
    }
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.into() }
}
