//! The few lines that a run ends with.

use std::fmt;

use nightflow::{
    clock::{Reservoir, Stage},
    node::Report,
};

/// A report, and where its outputs went.
pub struct Summary<'a> {
    /// What was counted.
    pub report: &'a Report,
    /// Files, folders and services.
    pub outputs: Vec<String>,
}

impl fmt::Display for Summary<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let report = self.report;
        let source = report.source;
        writeln!(f, "frames in     {:>7}", report.frames)?;
        writeln!(
            f,
            "stepped       {:>7}   ok {} · degraded {} · blind {}",
            report.steps, report.states[0], report.states[1], report.states[2]
        )?;
        writeln!(f, "unpaired      {:>7}   the first frame, or after a gap", report.unpaired)?;
        writeln!(
            f,
            "dropped       {:>7}   camera: {} displaced by a newer frame, {} small samples",
            source.displaced + source.overrun + report.lost.values().sum::<u64>(),
            source.displaced,
            source.overrun
        )?;
        for (sink, count) in report.lost.iter().filter(|(_, count)| **count > 0) {
            writeln!(f, "                        {sink}: {count} not taken")?;
        }
        writeln!(f, "spoiled       {:>7}", report.spoiled_count() + source.torn)?;
        for (cause, (count, newest)) in &report.spoiled {
            writeln!(f, "                        {cause}: {count}, the newest: {newest}")?;
        }
        if source.torn > 0 {
            writeln!(f, "                        camera: {} torn", source.torn)?;
        }
        if report.step_ms.seen() > 0 {
            writeln!(f, "milliseconds      p50      p95      p99")?;
            for stage in Stage::ALL {
                row(f, stage.name(), report.watch.of(stage))?;
            }
            row(f, "whole step", &report.step_ms)?;
        }
        match report.speeds.quantiles([0.5]) {
            Some([speed]) => writeln!(f, "median speed  {speed:>7.2}   m/s over {} steps", report.speeds.seen())?,
            None if report.steps > 0 => writeln!(f, "median speed        –   no metric velocity")?,
            None => {}
        }
        for (lack, count) in &report.lacks {
            writeln!(f, "                        {count} steps lacked {lack}")?;
        }
        let [looked, occupied, not] = report.sights;
        if looked + not > 0 {
            write!(f, "obstacles     {occupied:>7}   of {looked} steps saw something in the way")?;
            if let Some(least) = report.nearest_s {
                write!(f, ", the nearest in {least:.2} s")?;
            }
            writeln!(f, "; {not} could not look")?;
        }
        for output in &self.outputs {
            writeln!(f, "written                 {output}")?;
        }
        Ok(())
    }
}

fn row(f: &mut fmt::Formatter<'_>, name: &str, series: &Reservoir) -> fmt::Result {
    match series.quantiles([0.5, 0.95, 0.99]) {
        Some([p50, p95, p99]) => writeln!(f, "  {name:<12} {p50:>7.2}  {p95:>7.2}  {p99:>7.2}"),
        None => Ok(()),
    }
}
