//! Each sector of each step beside the truth, and the tables.

use std::fmt::Write as _;

use nightflow::{
    darkness::{course::Truth, ladder::MEANS},
    motion::{Obstacles, Sector},
};

/// A thing that is met within this must be seen, seconds; what is nearer than the least is too late for anybody.
pub const TTC_S: [f64; 2] = [1.0, 5.0];
/// What is met later than this is no obstacle: the settings' horizon and a quarter.
const CLEAR_S: f64 = 10.0;
/// As the node says it by default.
pub const SURE: f64 = 0.9;

/// One sector of one step.
#[derive(Debug, Clone)]
pub struct Row {
    pub course: String,
    pub seed: u64,
    pub method: usize,
    pub variant: usize,
    pub rung: usize,
    pub step: usize,
    pub sector: usize,
    /// Seconds, where something nears.
    pub truth: Option<f64>,
    /// The soonest here and beside.
    pub soonest: Option<f64>,
    /// Nothing nears in the sectors beside it either.
    pub clear: bool,
    pub found: Sector,
    /// The most certain word of an obstacle here or a sector beside, for a thing at the edge may be seen in either; and
    /// the soonest time that is told there with certainty.
    pub near: f64,
    pub near_s: Option<f64>,
}

impl Row {
    /// The sectors that lie in the camera's field.
    pub fn of(
        course: &str,
        (seed, method, variant): (u64, usize, usize),
        rung: usize,
        step: usize,
        truth: &Truth,
        found: Option<&Obstacles>,
    ) -> Vec<Row> {
        let said = |sector: usize| found.map_or(Sector::Unknown, |found| found.sectors[sector]);
        let sure = |sector: usize| match said(sector) {
            Sector::Occupied { confidence, .. } => confidence,
            _ => 0.0,
        };
        let time = |sector: usize| match said(sector) {
            Sector::Occupied { ttc_s, confidence, .. } if confidence >= SURE => Some(ttc_s),
            _ => None,
        };
        let beside = |sector: usize| sector - 1..=sector + 1;
        let inside = (1..truth.sectors.len() - 1).filter(|sector| truth.in_view[*sector]);
        let row = |sector: usize| Row {
            course: course.to_owned(),
            seed,
            method,
            variant,
            rung,
            step,
            sector,
            truth: truth.sectors[sector],
            soonest: beside(sector).filter_map(|near| truth.sectors[near]).min_by(f64::total_cmp),
            clear: beside(sector).all(|near| truth.sectors[near].is_none_or(|ttc| ttc > CLEAR_S)),
            found: said(sector),
            near: beside(sector).map(sure).fold(0.0, f64::max),
            near_s: beside(sector).filter_map(time).min_by(f64::total_cmp),
        };
        inside.map(row).collect()
    }

    /// Something is met soon enough to matter and late enough to help.
    pub fn due(&self) -> bool {
        self.truth.is_some_and(|ttc| (TTC_S[0]..=TTC_S[1]).contains(&ttc))
    }

    fn occupied(&self) -> f64 {
        match self.found {
            Sector::Occupied { confidence, .. } => confidence,
            _ => 0.0,
        }
    }

    fn freed(&self) -> bool {
        matches!(self.found, Sector::Free { confidence } if confidence >= SURE) && self.near < SURE
    }
}

/// Detections and false alarms from the surest word on.
#[derive(Debug, Clone, Copy, Default)]
pub struct Rates {
    pub due: usize,
    pub detected: f64,
    pub clear: usize,
    pub alarmed: f64,
}

/// At a bound of certainty; none where there is nothing to judge.
pub fn rates<'a>(rows: impl Iterator<Item = &'a Row>, sure: f64) -> Rates {
    let (mut rates, mut detected, mut alarmed) = (Rates::default(), 0, 0);
    for row in rows {
        if row.due() {
            rates.due += 1;
            detected += usize::from(row.near >= sure);
        } else if row.clear {
            rates.clear += 1;
            alarmed += usize::from(row.occupied() >= sure);
        }
    }
    rates.detected = detected as f64 / rates.due.max(1) as f64;
    rates.alarmed = alarmed as f64 / rates.clear.max(1) as f64;
    rates
}

/// Median and third quartile of the relative error of times to contact that were told, and how many there are.
fn errors<'a>(rows: impl Iterator<Item = &'a Row>) -> (f64, f64, usize) {
    let mut errors: Vec<f64> =
        rows.filter(|row| row.due()).filter_map(|row| Some((row.near_s? / row.soonest? - 1.0).abs())).collect();
    errors.sort_by(f64::total_cmp);
    let at = |part: f64| errors.get((errors.len() as f64 * part) as usize).copied().unwrap_or(f64::NAN);
    (at(0.5), at(0.75), errors.len())
}

/// One course down the ladder.
pub fn table(course: &str, rows: &[Row], method: usize, variant: usize) -> String {
    let mut out = format!(
        "| {course} | due | detected | said free | clear | false alarms | said free | TTC error, median | 75 % |\n\
         | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n"
    );
    for rung in 0..MEANS.len() {
        let of = || {
            let ours = move |row: &&Row| row.course == course && (row.method, row.variant) == (method, variant);
            rows.iter().filter(ours).filter(move |row| row.rung == rung)
        };
        if of().next().is_none() {
            continue;
        }
        let rates = rates(of(), SURE);
        let percent = |part: f64| if part.is_nan() { "–".into() } else { format!("{:.1} %", 100.0 * part) };
        let part = |count: usize, all: usize| count as f64 / all.max(1) as f64;
        let (median, upper, _) = errors(of());
        let missed = part(of().filter(|row| row.due() && row.freed()).count(), rates.due);
        let freed = part(of().filter(|row| row.clear && row.freed()).count(), rates.clear);
        let _ = writeln!(
            out,
            "| Exp-{rung} | {} | {:.3} | {missed:.3} | {} | {:.4} | {freed:.3} | {} | {} |",
            rates.due,
            rates.detected,
            rates.clear,
            rates.alarmed,
            percent(median),
            percent(upper)
        );
    }
    out
}

/// All rows, for other tools.
pub fn csv(rows: &[Row]) -> String {
    let mut out =
        String::from("course,seed,method,variant,exposure,step,sector,truth_ttc_s,clear,said,ttc_s,confidence\n");
    for row in rows {
        let (said, ttc, confidence) = match row.found {
            Sector::Unknown => ("unknown", f64::NAN, f64::NAN),
            Sector::Free { confidence } => ("free", f64::NAN, confidence),
            Sector::Occupied { ttc_s, confidence, .. } => ("occupied", ttc_s, confidence),
        };
        let _ = writeln!(
            out,
            "{},{},{},{},{},{},{},{:.4},{},{said},{ttc:.4},{confidence:.4}",
            row.course,
            row.seed,
            row.method,
            row.variant,
            row.rung,
            row.step,
            row.sector,
            row.truth.unwrap_or(f64::NAN),
            row.clear
        );
    }
    out
}
