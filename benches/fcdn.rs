//! How long a dark pair takes, beside numpy and OpenCV on the same pairs and cores: `cargo bench --bench fcdn`.
//!
//! Pairs of 512×384 lie in `/dev/shm` where there is such a thing (so that no disk is measured), or under `target`.

use std::{
    fs,
    path::Path,
    process::{Command, ExitCode},
    time::Instant,
};

use nightflow::darkness::{
    fcdn::{self, Pair, Set},
    recipes::Recipe,
};
use rayon::prelude::*;

// The other benches use the rest.
#[allow(dead_code)]
mod rivals;

use rivals::python;

const SIZE: [usize; 2] = [512, 384];
const PAIRS: usize = 120;
const RUNS: usize = 5;
/// Steps of a scale on which a picture's patches lie.
const OCTAVES: [usize; 4] = [96, 32, 8, 2];

fn hash(x: usize, y: usize, seed: usize) -> u32 {
    let mut z = (x as u32).wrapping_mul(0x9e37_79b9) ^ (y as u32).wrapping_mul(0x85eb_ca6b) ^ seed as u32;
    z = (z ^ (z >> 16)).wrapping_mul(0x7feb_352d);
    z = (z ^ (z >> 15)).wrapping_mul(0x846c_a68b);
    z ^ (z >> 16)
}

/// A picture of coloured patches upon patches.
fn picture(seed: usize) -> Vec<u8> {
    let mut bytes = format!("P6\n{} {}\n255\n", SIZE[0], SIZE[1]).into_bytes();
    for y in 0..SIZE[1] {
        for x in 0..SIZE[0] {
            for colour in 0..3 {
                let at = |step: usize| hash(x / step, y / step, seed * 16 + colour) % (step as u32 + 32);
                bytes.push(OCTAVES.into_iter().map(at).sum::<u32>().min(255) as u8);
            }
        }
    }
    bytes
}

fn flow() -> Vec<u8> {
    let mut bytes = b"PIEH".to_vec();
    bytes.extend(SIZE.iter().flat_map(|side| (*side as i32).to_le_bytes()));
    bytes.resize(12 + 8 * SIZE[0] * SIZE[1], 0);
    bytes
}

/// Median and shortest of several runs over all pairs, milliseconds a pair.
fn timed(mut run: impl FnMut()) -> [f64; 2] {
    let mut times: Vec<f64> = (0..RUNS)
        .map(|_| {
            let start = Instant::now();
            run();
            start.elapsed().as_secs_f64() * 1e3 / PAIRS as f64
        })
        .collect();
    times.sort_by(f64::total_cmp);
    [times[RUNS / 2], times[0]]
}

/// Reads, darkens and writes the frames, and leaves the flow alone: what the rival's functions do.
fn frames_alone(recipe: Recipe, pairs: &[Pair], to: &Path) {
    pairs.par_iter().for_each_init(<[Vec<u8>; 2]>::default, |frames, pair| {
        use std::io::Read;
        for (path, bytes) in pair.frames.iter().zip(frames.iter_mut()) {
            bytes.clear();
            let mut file = fs::File::open(path).expect("the frame is there");
            file.read_to_end(bytes).expect("the frame can be read");
        }
        let [older, newer] = frames;
        let begin = older.len() - 3 * SIZE[0] * SIZE[1];
        recipe.darken(1, pair.number, &mut older[begin..], &mut newer[begin..]).expect("a pair");
        for (path, bytes) in pair.frames.iter().zip(frames.iter()) {
            fs::write(to.join(path.file_name().expect("a name")), bytes).expect("the frame can be written");
        }
    });
}

/// Runs the rival's ways over the same pairs: milliseconds a pair by name.
fn run_rivals(from: &Path, to: &Path, cores: usize) -> Result<Vec<(String, f64)>, String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/rivals/fcdn.py");
    let output = Command::new(python()?)
        .arg(script)
        .args([from, to])
        .arg(cores.to_string())
        .output()
        .map_err(|error| error.to_string())?;
    let printed = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        return Err(format!("the rival failed:\n{printed}{}", String::from_utf8_lossy(&output.stderr)));
    }
    let line = |line: &str| {
        let (name, time) = line.split_once(' ')?;
        Some((name.to_owned(), time.trim().parse().ok()?))
    };
    Ok(printed.lines().filter_map(line).collect())
}

fn compare(home: &Path) -> Result<(), String> {
    let [from, to, theirs] = ["clean", "ours", "theirs"].map(|name| home.join(name));
    for folder in [&from, &to, &theirs] {
        fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    }
    let pictures: Vec<Vec<u8>> = (0..10).into_par_iter().map(picture).collect();
    for number in 0..PAIRS {
        let write = |part: &str, bytes: &[u8]| fs::write(from.join(format!("{number:05}_{part}")), bytes);
        write("img1.ppm", &pictures[number % 10])
            .and_then(|()| write("img2.ppm", &pictures[(number + 1) % 10]))
            .and_then(|()| write("flow.flo", &flow()))
            .map_err(|error| format!("{}: {error}", from.display()))?;
    }
    let pairs: Vec<Pair> = fcdn::pairs(&from).map_err(|error| error.to_string())?.into_iter().flatten().collect();
    let cores = rayon::current_num_threads();
    println!(
        "{PAIRS} pairs of {}x{} in {}, {cores} cores; ms a pair, median of {RUNS} (best)",
        SIZE[0],
        SIZE[1],
        home.display()
    );
    let mut ours = Vec::new();
    for recipe in Recipe::ALL {
        let mut memory = [pictures[0].clone(), pictures[1].clone()];
        let [older, newer] = &mut memory;
        let mut number = 0;
        let alone = timed(|| {
            for _ in 0..PAIRS {
                number += 1;
                recipe.darken(1, number, &mut older[15..], &mut newer[15..]).expect("a pair");
            }
        });
        let frames = timed(|| frames_alone(recipe, &pairs, &to));
        let folder = home.join(recipe.name());
        let set = Set::open(&folder, recipe, 1).map_err(|error| error.to_string())?;
        let whole = timed(|| set.make_all(&pairs, &|_, made| made.map(|_| ())).expect("the set can be made"));
        println!(
            "nightflow {recipe:<13} in memory, one core {:.3} ({:.3}); frames, all cores {:.3} ({:.3}); with the flow {:.3} ({:.3})",
            alone[0], alone[1], frames[0], frames[1], whole[0], whole[1]
        );
        ours.push((recipe, frames[0], whole[0]));
    }
    let rivals = run_rivals(&from, &theirs, cores)?;
    let copy = rivals.iter().find(|(name, _)| name == "copy_flow").map_or(0.0, |(_, time)| *time);
    for (name, time) in rivals {
        let against = if name == "authors_script" { Recipe::Authors2021 } else { Recipe::Paper };
        let Some((_, frames, whole)) = ours.iter().find(|(recipe, ..)| *recipe == against) else { continue };
        if name == "copy_flow" {
            println!("rival {name}: {time:.3}");
            continue;
        }
        println!(
            "rival {name}: frames {time:.3}: nightflow {against} is {:.1} times faster; with the flow {:.3}: {:.1} times",
            time / frames,
            time + copy,
            (time + copy) / whole
        );
    }
    Ok(())
}

fn main() -> ExitCode {
    let shared = Path::new("/dev/shm");
    let base = if shared.is_dir() { shared.to_owned() } else { Path::new(env!("CARGO_MANIFEST_DIR")).join("target") };
    let home = base.join(format!("nightflow-fcdn-{}", std::process::id()));
    let compared = compare(&home);
    let removed = fs::remove_dir_all(&home);
    match compared.and_then(|()| removed.map_err(|error| format!("{}: {error}", home.display()))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(reason) => {
            eprintln!("no comparison with numpy and OpenCV: {reason}");
            ExitCode::FAILURE
        }
    }
}
