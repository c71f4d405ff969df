//! Pairs a second on one core, noise and record included: `cargo bench --bench scenes` (textures by formula), or with `PHOTOS=folder` before it.

use std::{hint::black_box, path::Path, process::ExitCode, time::Instant};

use nightflow::darkness::{
    recipes::Recipe,
    scenes::{Library, Part, Preset, Scenes, Settings, stream},
};

/// What the trainer's feed needs of a core.
const NEEDED: f64 = 25.0;
const PAIRS: u64 = 100;

fn main() -> ExitCode {
    // `cargo test --benches` only shows that it still runs.
    let pairs = if std::env::args().any(|arg| arg == "--bench") { PAIRS } else { 2 };
    let mut slow = false;
    for preset in [Preset::Chairs, Preset::Drone] {
        let library = match std::env::var_os("PHOTOS") {
            Some(folder) => match Library::read(Path::new(&folder), None, Part::All) {
                Ok(library) => library,
                Err(error) => {
                    eprintln!("{error}");
                    return ExitCode::from(2);
                }
            },
            None => Library::by_formula(1),
        };
        let settings = Settings { preset, size: [448, 320], seed: 1, recipe: Some(Recipe::Paper) };
        let scenes = match Scenes::new(settings, library) {
            Ok(scenes) => scenes,
            Err(error) => {
                eprintln!("{error}");
                return ExitCode::from(2);
            }
        };
        let mut times: Vec<f64> = Vec::new();
        let start = Instant::now();
        for index in 0..pairs {
            let begin = Instant::now();
            let mut record = Vec::new();
            stream::append(&scenes.pair(index), stream::Precision::Half, &mut record);
            black_box(record);
            times.push(begin.elapsed().as_secs_f64() * 1e3);
        }
        let rate = pairs as f64 / start.elapsed().as_secs_f64();
        times.sort_by(f64::total_cmp);
        let at = |part: f64| times[((times.len() - 1) as f64 * part) as usize];
        println!(
            "{preset:>7} 448x320: {rate:.1} pairs/s a core over {pairs} pairs (ms a pair: median {:.1}, 10 % {:.1}, 90 % {:.1})",
            at(0.5),
            at(0.1),
            at(0.9)
        );
        slow |= rate < NEEDED;
    }
    println!("{}", if slow { "slower than the 25 pairs/s that are needed" } else { "as fast as is needed" });
    ExitCode::SUCCESS
}
