//! How good and how honest velocity is, from dusk to dark: `cargo bench --bench velocity -- --flights 256`.
//!
//! Flights over `darkness::flight`'s ground are photographed at the ladder's seven exposures and go through the node's
//! own stages: exposure, a network, odometer. Gyro and accelerometer (noise and bias), range, stamps, attitude and the gyro's clock err as
//! much as the settings say. Flow may be kept in a folder (`--cache`), so that a change of the fit is judged in seconds.
//! A network's name with `+refine` or `-refine` behind it is judged with and without the last step by the images' gradients.

use std::{
    path::PathBuf,
    process::ExitCode,
    sync::atomic::{AtomicU64, Ordering},
    time::Instant,
};

use nightflow::{
    darkness::{noise::Noise, profiles},
    flow::Matcher,
    motion::Config,
};

mod flights;
mod opencv;
mod plot;
#[allow(dead_code)]
#[path = "../rivals/mod.rs"]
mod rivals;
mod seen;
mod tables;

use flights::Plan;
use seen::Taken;
use tables::Row;

/// What is asked for.
struct Asked {
    flights: u64,
    /// The first flight's number.
    first: u64,
    steps: usize,
    /// One flight of so many hovers.
    hovers: u64,
    size: [usize; 2],
    methods: Vec<String>,
    threads: usize,
    cache: Option<PathBuf>,
    csv: Option<PathBuf>,
    plot: Option<PathBuf>,
    /// `[motion]` settings that differ, as TOML.
    motion: Config,
}

impl Asked {
    /// Under `cargo test --benches` it only shows that it still runs.
    fn read() -> Result<Asked, String> {
        let words: Vec<String> = std::env::args().skip(1).collect();
        let bench = words.iter().any(|word| word == "--bench");
        let mut asked = Asked {
            flights: if bench { 40 } else { 1 },
            first: 0,
            steps: if bench { 8 } else { 2 },
            hovers: 8,
            size: if bench { [640, 480] } else { [320, 256] },
            methods: vec!["pwcnet_fcdn".into()],
            threads: 2,
            cache: None,
            csv: None,
            plot: None,
            motion: Config::default(),
        };
        let mut words = words.iter().filter(|word| *word != "--bench");
        while let Some(word) = words.next() {
            let Some(value) = words.next() else { break };
            let number = || value.parse().map_err(|error| format!("{word} {value}: {error}"));
            match word.as_str() {
                "--flights" => asked.flights = number()?,
                "--first" => asked.first = number()?,
                "--steps" => asked.steps = number()? as usize,
                "--hovers" => asked.hovers = number()?.max(1),
                "--threads" => asked.threads = number()? as usize,
                "--width" => asked.size = [number()? as usize, number()? as usize * 3 / 4],
                "--methods" => asked.methods = value.split(',').map(str::to_owned).collect(),
                "--cache" => asked.cache = Some(value.into()),
                "--motion" => asked.motion = toml::from_str(value).map_err(|error| error.to_string())?,
                "--plot" => asked.plot = Some(value.into()),
                "--csv" => asked.csv = Some(value.into()),
                _ => {
                    return Err(format!(
                        "{word} is not known: --flights --first --steps --hovers --threads --width --methods --cache --csv --plot --motion"
                    ));
                }
            }
        }
        if let Some(folder) = &asked.cache {
            std::fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        }
        Ok(asked)
    }
}

/// One thread's share: flights as they are free, each seen by every method.
fn work(asked: &Asked, camera: &Noise, next: &AtomicU64) -> Result<Vec<Vec<Row>>, String> {
    let mut matchers: Vec<Option<Matcher>> = asked.methods.iter().map(|_| None).collect();
    let mut rows = vec![vec![]; asked.methods.len()];
    loop {
        let number = next.fetch_add(1, Ordering::Relaxed);
        if number >= asked.first + asked.flights {
            return Ok(rows);
        }
        let mut taken = Taken::new(Plan::draw(number, asked.steps, asked.size, asked.hovers), asked.cache.as_deref())?;
        for ((name, rows), matcher) in asked.methods.iter().zip(&mut rows).zip(&mut matchers) {
            let mut seen = taken.seen_by(name, matcher, camera)?;
            taken.look_back(name, camera, &mut seen)?;
            rows.extend(tables::judge(&taken.sensors, &seen, &asked.motion)?);
        }
    }
}

fn run() -> Result<(), String> {
    let asked = Asked::read()?;
    let camera = profiles::find("Canon EOS M6", 3200).map_err(|error| error.to_string())?;
    let (next, start) = (AtomicU64::new(asked.first), Instant::now());
    let shares: Vec<Result<Vec<Vec<Row>>, String>> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..asked.threads.max(1)).map(|_| scope.spawn(|| work(&asked, &camera, &next))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap_or(Err("a thread fell".into()))).collect()
    });
    let mut rows = vec![vec![]; asked.methods.len()];
    for share in shares {
        for (rows, share) in rows.iter_mut().zip(share?) {
            rows.extend(share);
        }
    }
    println!(
        "{} flights of {} steps, {}x{} 12 bit, Canon EOS M6 at ISO 3200, in {:.0} s",
        asked.flights,
        asked.steps,
        asked.size[0],
        asked.size[1],
        start.elapsed().as_secs_f64()
    );
    let mut lines = String::new();
    for (name, rows) in asked.methods.iter().zip(&mut rows) {
        rows.sort_by_key(|row| row.plan.number);
        println!("{}", tables::report(name, rows));
        lines += &tables::csv(name, rows);
    }
    if let (Some(path), Some(rows)) = (&asked.plot, rows.first()) {
        plot::draw(path, rows).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    if let Some(path) = &asked.csv {
        std::fs::write(path, lines).map_err(|error| format!("{}: {error}", path.display()))?;
    }
    Ok(())
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("velocity was not measured: {reason}");
            ExitCode::FAILURE
        }
    }
}
