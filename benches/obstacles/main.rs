//! How well obstacles are found, from dusk to dark: `cargo bench --bench obstacles -- --seeds 3`.
//!
//! A simulated drone flies at a wall, poles, a wire, thin rods and things that move (`darkness::course`), photographed at the ladder's
//! seven exposures, and its frames go through the node's own stages. Each sector of each step is held against the truth:
//! detections against false alarms, and how far off the time to contact is.

use std::{
    path::PathBuf,
    process::ExitCode,
    sync::atomic::{AtomicUsize, Ordering},
    time::Instant,
};

use nightflow::{
    darkness::{noise::Noise, profiles},
    flow,
    motion::obstacles,
};

#[path = "../velocity/opencv.rs"]
mod opencv;
mod plot;
#[allow(dead_code)]
#[path = "../rivals/mod.rs"]
mod rivals;
mod score;
mod seen;

use score::Row;
use seen::{COURSES, Plan};

/// What is asked for.
pub struct Asked {
    seeds: u64,
    frames: usize,
    courses: Vec<String>,
    rungs: Vec<usize>,
    methods: Vec<String>,
    threads: usize,
    size: [usize; 2],
    csv: Option<PathBuf>,
    plot: Option<PathBuf>,
    /// Settings of `[flow]` that differ, as TOML.
    flow: flow::Config,
    /// Settings of `[motion.obstacles]` that differ, as TOML; each is judged on the same flow.
    variants: Vec<String>,
}

impl Asked {
    /// Under `cargo test --benches` it only shows that it still runs.
    fn read() -> Result<Asked, String> {
        let words: Vec<String> = std::env::args().skip(1).collect();
        let bench = words.iter().any(|word| word == "--bench");
        let mut asked = Asked {
            seeds: 1,
            frames: if bench { 56 } else { 4 },
            courses: COURSES
                .iter()
                .take(if bench { COURSES.len() } else { 1 })
                .map(|name| (*name).to_owned())
                .collect(),
            rungs: if bench { (0..7).collect() } else { vec![2] },
            methods: vec!["pwcnet_fcdn".into()],
            threads: 2,
            size: if bench { [640, 480] } else { [320, 256] },
            csv: None,
            plot: None,
            // As launch_configs/forward_avoidance.toml has it.
            flow: flow::Config { refine_narrow: true, ..flow::Config::default() },
            variants: vec![],
        };
        let list = |value: &String| value.split(',').map(str::to_owned).collect::<Vec<String>>();
        let mut words = words.iter().filter(|word| *word != "--bench");
        while let Some(word) = words.next() {
            let Some(value) = words.next() else { break };
            let number = |value: &str| value.parse().map_err(|error| format!("{word} {value}: {error}"));
            match word.as_str() {
                "--seeds" => asked.seeds = number(value)? as u64,
                "--frames" => asked.frames = number(value)?,
                "--threads" => asked.threads = number(value)?,
                "--courses" => asked.courses = list(value),
                "--exposures" => asked.rungs = list(value).iter().map(|rung| number(rung)).collect::<Result<_, _>>()?,
                "--methods" => asked.methods = list(value),
                "--csv" => asked.csv = Some(value.into()),
                "--plot" => asked.plot = Some(value.into()),
                "--flow" => asked.flow = toml::from_str(value).map_err(|error| error.to_string())?,
                "--obstacles" => asked.variants.push(value.clone()),
                _ => {
                    return Err(format!(
                        "{word} is not known: --seeds --frames --threads --courses {} --exposures --methods --csv --plot --flow --obstacles",
                        COURSES.join(",")
                    ));
                }
            }
        }
        if asked.variants.is_empty() {
            asked.variants.push(String::new());
        }
        if let Some(wrong) = asked.courses.iter().find(|name| !COURSES.contains(&name.as_str())) {
            return Err(format!("no course is named {wrong}; there are {}", COURSES.join(", ")));
        }
        if let Some(wrong) = asked.rungs.iter().find(|rung| **rung > 6) {
            return Err(format!("exposure {wrong}: expected 0 to 6"));
        }
        Ok(asked)
    }

    fn plans(&self) -> Vec<Plan> {
        let plan = |seed, course: &String| Plan { seed, course: course.clone(), frames: self.frames, size: self.size };
        (1..=self.seeds).flat_map(|seed| self.courses.iter().map(move |course| plan(seed, course))).collect()
    }

    /// The settings to be judged. A low bound leaves the curve of detections against false alarms its whole length.
    fn configs(&self) -> Result<Vec<obstacles::Config>, String> {
        let config = |text: &String| {
            let config: obstacles::Config = toml::from_str(text).map_err(|error| format!("{text}: {error}"))?;
            Ok(obstacles::Config { confidence_min: 0.5, ..config })
        };
        self.variants.iter().map(config).collect()
    }
}

/// One thread's share: courses as they are free.
fn work(asked: &Asked, plans: &[Plan], camera: &Noise, next: &AtomicUsize) -> Result<Vec<Row>, String> {
    let configs = asked.configs()?;
    let mut matchers =
        asked.methods.iter().map(|name| seen::matcher(name, &asked.flow)).collect::<Result<Vec<_>, _>>()?;
    let mut rows = vec![];
    while let Some(plan) = plans.get(next.fetch_add(1, Ordering::Relaxed)) {
        let flown = seen::fly(plan)?;
        for rung in &asked.rungs {
            for (method, (name, matcher)) in asked.methods.iter().zip(&mut matchers).enumerate() {
                rows.extend(seen::look(&flown, *rung, method, name, matcher, camera, &configs)?);
            }
        }
        eprintln!("{} {} is done", plan.course, plan.seed);
    }
    Ok(rows)
}

fn run() -> Result<(), String> {
    let asked = Asked::read()?;
    let camera = profiles::find("Canon EOS M6", 3200).map_err(|error| error.to_string())?;
    let (plans, next, start) = (asked.plans(), AtomicUsize::new(0), Instant::now());
    let shares: Vec<Result<Vec<Row>, String>> = std::thread::scope(|scope| {
        let threads: Vec<_> =
            (0..asked.threads.max(1)).map(|_| scope.spawn(|| work(&asked, &plans, &camera, &next))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap_or(Err("a thread fell".into()))).collect()
    });
    let mut rows = vec![];
    for share in shares {
        rows.extend(share?);
    }
    println!(
        "{} flights of {} frames, {}x{} 12 bit at 15 Hz, 3 m/s, Canon EOS M6 at ISO 3200, in {:.0} s",
        plans.len(),
        asked.frames,
        asked.size[0],
        asked.size[1],
        start.elapsed().as_secs_f64()
    );
    for (method, name) in asked.methods.iter().enumerate() {
        for (variant, text) in asked.variants.iter().enumerate() {
            println!("\n{name} {text}");
            for course in &asked.courses {
                println!("{}", score::table(course, &rows, method, variant));
            }
        }
    }
    if let Some(path) = &asked.csv {
        std::fs::write(path, score::csv(&rows)).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    if let Some(path) = &asked.plot {
        plot::draw(path, &rows, &asked.courses).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    Ok(())
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("obstacles were not measured: {reason}");
            ExitCode::FAILURE
        }
    }
}
