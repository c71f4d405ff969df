//! The odometer over what was seen, and the tables: how far off, how honest, and what quality is worth.

use std::fmt::Write as _;

use nalgebra::{Matrix6, Vector3, Vector6};
use nightflow::{
    camera::Sample,
    clock::Stamp,
    darkness::ladder::MEANS,
    motion::{BOUND_M_S, BOUND_PART, BOUND_PER_S, Config, Drift, Keeping, Odometer, Velocity},
};

use super::{
    flights::{Plan, Sensors},
    seen::{Seen, Step},
};

/// The bound that quality is about: metres a second, and a part of the speed.
pub const BOUND: [f64; 2] = [BOUND_M_S, BOUND_PART];
/// Groups of flights that stand for seeds.
const SEEDS: u64 = 5;
const BINS: usize = 8;

/// One step's velocity beside the truth; without one only what was flown.
#[derive(Debug, Clone)]
pub struct Row {
    pub plan: Plan,
    pub rung: usize,
    pub blind: bool,
    pub noise_level: f32,
    pub truth: Vector3<f64>,
    pub found: Option<Found>,
    /// What gyro and camera disagree on so far.
    pub drift: Option<Drift>,
    /// The flow straight below.
    pub below: Option<Below>,
}

/// An autopilot's flow beside the truth.
#[derive(Debug, Clone, Copy)]
pub struct Below {
    pub quality: u8,
    /// Length of the error, and of the true rate without the body's turn, rad/s.
    pub error: f64,
    pub rate: f64,
}

#[derive(Debug, Clone)]
pub struct Found {
    pub velocity: Velocity,
    /// m/s, body (FLU).
    pub error: Vector3<f64>,
    /// Normalised errors squared: of the linear velocity (3) and of all (6).
    pub nees: [f64; 2],
}

impl Row {
    fn speed(&self) -> f64 {
        self.truth.norm()
    }

    /// The velocity that the node would publish.
    fn published(&self) -> Option<&Found> {
        self.found.as_ref().filter(|_| !self.blind)
    }
}

/// Where [`follow`] is.
pub struct At {
    pub step: usize,
    pub older: Stamp,
    pub newer: Stamp,
    /// Columns and rows of the camera.
    pub size: [u32; 2],
    pub velocity: Option<Velocity>,
}

/// Takes an odometer along what was seen of a flight; `then` is told what is to be done about the kept frame.
pub fn follow(
    sensors: &Sensors,
    steps: &[Step],
    config: &Config,
    mut then: impl FnMut(&At, &mut Odometer, Keeping) -> Result<(), String>,
) -> Result<(), String> {
    let mut odometer = Odometer::new(config).map_err(|error| error.to_string())?;
    odometer.info(&sensors.info).map_err(|error| error.to_string())?;
    let (samples, stamps) = sensors.disturbed(config);
    let mut samples = samples.iter().peekable();
    for (index, step) in steps.iter().enumerate() {
        let (older, newer) = (stamps[index], stamps[index + 1]);
        while let Some(sample) = samples.next_if(|sample| sample.stamp() <= newer) {
            let taken = match sample {
                Sample::Imu(imu) => odometer.imu(imu),
                Sample::Range(range) => odometer.range(range),
                Sample::Info(_) | Sample::Frame(_) | Sample::Transforms(_) | Sample::Width(_) => Ok(()),
            };
            taken.map_err(|error| error.to_string())?;
        }
        let size = sensors.plan.size.map(|side| side as u32);
        let velocity = odometer.velocity_with(&step.flow(older, newer), step.gradients(), size).ok();
        let keeping = match &velocity {
            Some(velocity) => odometer.keep(velocity),
            None => {
                odometer.let_go();
                Keeping::Wait
            }
        };
        then(&At { step: index, older, newer, size, velocity }, &mut odometer, keeping)?;
    }
    Ok(())
}

/// The velocities of one flight at all exposures.
pub fn judge(sensors: &Sensors, seen: &Seen, config: &Config) -> Result<Vec<Row>, String> {
    let mut rows = vec![];
    for (rung, steps) in seen.iter().enumerate() {
        let mut frames = vec![];
        follow(sensors, steps, config, |at, odometer, keeping| {
            let (step, At { older, newer, .. }) = (&steps[at.step], at);
            frames.push(*newer);
            let back = step.back.as_ref().filter(|_| keeping == Keeping::Compare);
            let kept = back.and_then(|back| Some((back, *frames.get(back.kept.checked_sub(1)?)?)));
            match kept.and_then(|(back, kept)| back.read(step.grid, kept, *newer)) {
                Some((flow, gradients)) => odometer.look_back(&flow, &gradients, at.size),
                None if keeping == Keeping::Compare => odometer.let_go(),
                None => {}
            }
            let integrated = odometer.integrated(&step.flow(*older, *newer), at.size, false);
            let seconds = newer.seconds_since(*older);
            let [moved, turned] = sensors.below(at.step + 1, seconds);
            let length = |[x, y]: [f64; 2]| x.hypot(y) / seconds;
            let below = integrated.flow.ok().map(|angles| Below {
                quality: integrated.quality,
                error: length([0, 1].map(|i| angles[i] - moved[i] - turned[i])),
                rate: length(moved),
            });
            let row = row(sensors, rung, at.step + 1, step, at.velocity);
            rows.push(Row { drift: odometer.drift(), below, ..row });
            Ok(())
        })?;
    }
    Ok(rows)
}

fn row(sensors: &Sensors, rung: usize, newer: usize, step: &Step, velocity: Option<Velocity>) -> Row {
    let (truth, rates) = sensors.mean(newer);
    let found = velocity.map(|velocity| {
        let error = Vector3::from(velocity.linear) - truth;
        let turn = Vector3::from(velocity.angular) - rates;
        let covariance = Matrix6::from_fn(|i, j| velocity.covariance[i][j]);
        let linear = covariance.fixed_view::<3, 3>(0, 0).into_owned().try_inverse().unwrap_or_default();
        let both = Vector6::new(error.x, error.y, error.z, turn.x, turn.y, turn.z);
        let all = covariance.try_inverse().unwrap_or_default();
        let nees = [(error.transpose() * linear * error)[0], (both.transpose() * all * both)[0]];
        Found { velocity, error, nees }
    });
    Row {
        plan: sensors.plan,
        rung,
        blind: step.blind,
        noise_level: step.noise_level,
        truth,
        found,
        drift: None,
        below: None,
    }
}

/// Mean, and how far it may be off: flights are independent, the steps of one are not.
fn mean(rows: &[(u64, f64)]) -> (f64, f64) {
    let count = rows.len().max(1) as f64;
    let mean = rows.iter().map(|(_, value)| value).sum::<f64>() / count;
    let mut flights: std::collections::BTreeMap<u64, f64> = Default::default();
    for (flight, value) in rows {
        *flights.entry(*flight).or_default() += value - mean;
    }
    (mean, flights.values().map(|sum| sum * sum).sum::<f64>().sqrt() / count)
}

fn quantile(mut values: Vec<f64>, part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(((values.len().max(1) - 1) as f64 * part).round() as usize).copied().unwrap_or(f64::NAN)
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value * value, count + 1.0));
    (sum / count).sqrt()
}

/// Root mean square over all, and the deviation between the seeds' own.
fn seeded(rows: &[(&Row, &Found)], measure: impl Fn(&Row, &Found) -> f64) -> String {
    let all = rms(rows.iter().map(|(row, found)| measure(row, found)));
    let seeds: Vec<f64> = (0..SEEDS)
        .map(|seed| {
            let of = rows.iter().filter(|(row, _)| row.plan.number % SEEDS == seed);
            rms(of.map(|(row, found)| measure(row, found)))
        })
        .collect();
    let middle = seeds.iter().sum::<f64>() / SEEDS as f64;
    let spread = (seeds.iter().map(|value| (value - middle).powi(2)).sum::<f64>() / (SEEDS as f64 - 1.0)).sqrt();
    format!("{all:.3} ± {spread:.3}")
}

/// Everything that is shown of one method.
pub fn report(name: &str, rows: &[Row]) -> String {
    let mut text = format!("\n## {name}\n");
    errors(&mut text, rows);
    hovering(&mut text, rows);
    honesty(&mut text, rows);
    quality(&mut text, rows);
    straight_below(&mut text, rows);
    watch(&mut text, rows);
    text
}

/// Shown where flights are long enough for the watch over clock and scale to speak; both are right but for the drawn
/// error of the gyro's clock.
fn watch(text: &mut String, rows: &[Row]) {
    let last = rows.iter().zip(rows.iter().skip(1).map(Some).chain([None]));
    let ends =
        last.filter(|(row, next)| next.is_none_or(|next| (next.plan.number, next.rung) != (row.plan.number, row.rung)));
    for (row, drift) in ends.filter_map(|(row, _)| Some((row, row.drift?))) {
        let scale: Vec<String> = (0..3).map(|i| format!("{:.3} ± {:.3}", drift.scale[i], drift.scale_sd[i])).collect();
        let _ = writeln!(
            text,
            "flight {} Exp-{}: gyro clock {:.2} ± {:.2} ms ahead, scale {}, said: {}",
            row.plan.number,
            row.rung,
            1e3 * drift.offset_s,
            1e3 * drift.offset_sd_s,
            scale.join(", "),
            drift.diagnosis(&Config::default()).map_or("nothing".into(), |said| said.to_string())
        );
    }
}

fn errors(text: &mut String, rows: &[Row]) {
    let _ = writeln!(
        text,
        "\nSpeed and velocity of what is published (flights of 0.5–8 m/s at 2–30 m, ± between {SEEDS} seeds)\n\n\
         | | noise, 1/255 | steps | published | blind | velocity RMSE, m/s | relative | median, m/s | speed RMSE over the target |\n\
         | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    );
    for rung in 0..MEANS.len() {
        let here: Vec<&Row> = rows.iter().filter(|row| row.rung == rung && !row.plan.hovers()).collect();
        let found: Vec<(&Row, &Found)> = here.iter().filter_map(|row| Some((*row, row.published()?))).collect();
        let count = here.len().max(1) as f64;
        let level =
            quantile(here.iter().map(|row| f64::from(row.noise_level)).filter(|l| l.is_finite()).collect(), 0.5);
        let [part, floor] = if rung < 5 { [0.03, 0.03] } else { [0.08, 0.05] };
        let speed = |row: &Row, found: &Found| Vector3::from(found.velocity.linear).norm() - row.speed();
        let _ = writeln!(
            text,
            "| Exp-{rung} | {level:.1} | {} | {:.1} % | {:.1} % | {} | {} | {:.3} | {} |",
            here.len(),
            100.0 * found.len() as f64 / count,
            100.0 * here.iter().filter(|row| row.blind).count() as f64 / count,
            seeded(&found, |_, found| found.error.norm()),
            seeded(&found, |row, found| found.error.norm() / row.speed()),
            quantile(found.iter().map(|(_, found)| found.error.norm()).collect(), 0.5),
            seeded(&found, |row, found| speed(row, found) / (part * row.speed() + floor)),
        );
    }
}

fn hovering(text: &mut String, rows: &[Row]) {
    let _ = writeln!(
        text,
        "\nHovering: phantom speed over ground (horizontal error) of what is published\n\n\
         | | steps | blind | published | RMSE, m/s | below 10 m, m/s | blind and published |\n| --- | --- | --- | --- | --- | --- | --- |"
    );
    for rung in 0..MEANS.len() {
        let here: Vec<&Row> = rows.iter().filter(|row| row.rung == rung && row.plan.hovers()).collect();
        let found: Vec<(&Row, &Found)> = here.iter().filter_map(|row| Some((*row, row.published()?))).collect();
        let phantom = |found: &Found| found.error.x.hypot(found.error.y);
        let low = found.iter().filter(|(row, _)| row.plan.height < 10.0);
        let _ = writeln!(
            text,
            "| Exp-{rung} | {} | {} | {} | {:.3} | {:.3} | {} |",
            here.len(),
            here.iter().filter(|row| row.blind).count(),
            found.len(),
            rms(found.iter().map(|(_, found)| phantom(found))),
            rms(low.map(|(_, found)| phantom(found))),
            here.iter().filter(|row| row.blind && row.published().is_some()).count(),
        );
    }
}

fn honesty(text: &mut String, rows: &[Row]) {
    let _ = writeln!(
        text,
        "\nNormalised error squared over its degrees of freedom (honest: 1), of every step with a fit, blind or not\n\n\
         | | steps | linear, mean ± s.e. | median | within 95 % | published | all six |\n| --- | --- | --- | --- | --- | --- | --- |"
    );
    for rung in 0..MEANS.len() {
        let found: Vec<(&Row, &Found)> =
            rows.iter().filter(|row| row.rung == rung).filter_map(|row| Some((row, row.found.as_ref()?))).collect();
        let each = |of: &dyn Fn(&Found) -> f64, published: bool| -> Vec<(u64, f64)> {
            let told = found.iter().filter(|(row, _)| !(published && row.blind));
            told.map(|(row, found)| (row.plan.number, of(found))).collect()
        };
        let linear = each(&|found| found.nees[0] / 3.0, false);
        let (middle, error) = mean(&linear);
        // 2.366 is the median of χ² of three degrees of freedom, 7.815 its 95 %.
        let within = linear.iter().filter(|(_, value)| value * 3.0 < 7.815).count() as f64 / linear.len().max(1) as f64;
        let (all, all_error) = mean(&each(&|found| found.nees[1] / 6.0, false));
        let published = each(&|found| found.nees[0] / 3.0, true);
        let (told, told_error) = mean(&published);
        let _ = writeln!(
            text,
            "| Exp-{rung} | {} | {middle:.2} ± {error:.2} | {:.2} | {:.1} % | {} | {all:.2} ± {all_error:.2} |",
            linear.len(),
            quantile(linear.iter().map(|(_, value)| value * 3.0 / 2.366).collect(), 0.5),
            100.0 * within,
            if published.is_empty() { "–".into() } else { format!("{told:.2} ± {told_error:.2}") },
        );
    }
}

/// Mean normalised error squared of the linear velocity over its three degrees of freedom, and how far it may be off.
pub fn nees(rows: &[Row], rung: usize) -> (f64, f64) {
    let here = rows.iter().filter(|row| row.rung == rung);
    let linear: Vec<_> = here.filter_map(|row| Some((row.plan.number, row.found.as_ref()?.nees[0] / 3.0))).collect();
    mean(&linear)
}

/// Whether the velocity is within the bound that quality is about.
pub fn within(row: &Row, found: &Found) -> bool {
    found.error.norm() <= BOUND[0] + BOUND[1] * row.speed()
}

/// (mean quality, part within the bound, its standard error, steps) by bin of quality.
pub fn curve(rows: &[Row], of: impl Fn(&Row) -> bool) -> Vec<(f64, f64, f64, usize)> {
    let told: Vec<(&Row, &Found)> =
        rows.iter().filter(|row| of(row)).filter_map(|row| Some((row, row.found.as_ref()?))).collect();
    (0..BINS)
        .filter_map(|bin| {
            let of = |quality: u8| usize::from(quality) * BINS / 256 == bin;
            let here: Vec<_> = told.iter().filter(|(_, found)| of(found.velocity.quality)).collect();
            let count = here.len() as f64;
            let quality = here.iter().map(|(_, found)| f64::from(found.velocity.quality) / 255.0).sum::<f64>() / count;
            let hits: Vec<_> =
                here.iter().map(|(row, found)| (row.plan.number, f64::from(u8::from(within(row, found))))).collect();
            let (part, error) = mean(&hits);
            (!here.is_empty()).then_some((quality, part, error, here.len()))
        })
        .collect()
}

fn quality(text: &mut String, rows: &[Row]) {
    let _ = writeln!(
        text,
        "\nQuality / 255 beside the part of the steps within {} m/s + {} % of the speed\n\n\
         | | steps | mean quality | within the bound |\n| --- | --- | --- | --- |",
        BOUND[0],
        100.0 * BOUND[1]
    );
    let sets: [(&str, [usize; 2]); 3] = [("all", [0, 6]), ("Exp-0…3", [0, 3]), ("Exp-4…6", [4, 6])];
    for (name, [first, last]) in sets {
        for (quality, part, error, count) in curve(rows, |row| (first..=last).contains(&row.rung)) {
            let _ = writeln!(text, "| {name} | {count} | {quality:.3} | {part:.3} ± {error:.3} |");
        }
    }
}

fn straight_below(text: &mut String, rows: &[Row]) {
    let _ = writeln!(
        text,
        "\nThe flow straight below: its quality / 255 beside the part of the steps within {BOUND_PER_S} rad/s + {} % of the rate\n\n\
         | | steps | mean quality | within the bound | error, median, rad/s |\n| --- | --- | --- | --- | --- |",
        100.0 * BOUND_PART
    );
    let sets: [(&str, [usize; 2]); 3] = [("all", [0, 6]), ("Exp-0…3", [0, 3]), ("Exp-4…6", [4, 6])];
    for ((name, [first, last]), bin) in sets.iter().flat_map(|set| (0..BINS).map(move |bin| (set, bin))) {
        let here: Vec<(u64, Below)> = rows
            .iter()
            .filter(|row| (first..=last).contains(&&row.rung))
            .filter_map(|row| Some((row.plan.number, row.below?)))
            .filter(|(_, below)| usize::from(below.quality) * BINS / 256 == bin)
            .collect();
        if here.is_empty() {
            continue;
        }
        let quality = here.iter().map(|(_, below)| f64::from(below.quality) / 255.0).sum::<f64>() / here.len() as f64;
        let hit = |below: &Below| f64::from(u8::from(below.error <= BOUND_PER_S + BOUND_PART * below.rate));
        let hits: Vec<(u64, f64)> = here.iter().map(|(number, below)| (*number, hit(below))).collect();
        let (part, error) = mean(&hits);
        let median = quantile(here.iter().map(|(_, below)| below.error).collect(), 0.5);
        let _ = writeln!(text, "| {name} | {} | {quality:.3} | {part:.3} ± {error:.3} | {median:.4} |", here.len());
    }
}

/// Every row as a line of a table for other programs.
pub fn csv(name: &str, rows: &[Row]) -> String {
    let mut text = String::new();
    for row in rows {
        let Plan { number, speed, height, .. } = row.plan;
        let _ = write!(
            text,
            "{name},{},{number},{speed},{height},{},{},{},{},{}",
            row.rung,
            u8::from(row.blind),
            row.noise_level,
            row.truth.x,
            row.truth.y,
            row.truth.z
        );
        if let Some(Found { velocity, error, nees }) = &row.found {
            let _ = write!(
                text,
                ",{},{},{},{},{},{},{},{}",
                error.x, error.y, error.z, nees[0], nees[1], velocity.samples, velocity.inliers, velocity.quality
            );
            for (i, j) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)] {
                let _ = write!(text, ",{}", velocity.covariance[i][j]);
            }
            if let Some(Below { quality, error, rate }) = row.below {
                let _ = write!(text, ",{quality},{error},{rate}");
            }
        }
        text.push('\n');
    }
    text
}
