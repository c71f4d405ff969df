//! What the benches share with their rivals in Python: the frames that both make, and the environment they run in.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// Black level of the frames.
pub const BLACK: u32 = 64;
/// White level of the frames.
pub const WHITE: u32 = 4095;

/// Even bits from two numbers and a seed.
pub fn hash(x: u32, y: u32, seed: u32) -> u32 {
    let mut z = x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b) ^ seed.wrapping_mul(0xc2b2_ae35);
    z = (z ^ (z >> 16)).wrapping_mul(0x7feb_352d);
    z = (z ^ (z >> 15)).wrapping_mul(0x846c_a68b);
    z ^ (z >> 16)
}

/// A count of the night scene that `develop.py` makes by the same formula: a chequered ground, noise, one lamp and some
/// hot pixels.
pub fn count(x: u32, y: u32, seed: u32) -> u16 {
    let z = hash(x, y, seed);
    let ground = 20 + 60 * ((x / 64 + y / 64) % 2);
    if (600..640).contains(&x) && (500..540).contains(&y) {
        WHITE as u16
    } else if x % 160 == 97 && y % 128 == 33 {
        3000
    } else {
        (BLACK + ground + (z & 15) + (z >> 4 & 15) - 15) as u16
    }
}

/// A Python with what the rivals import, installed once under `target/rivals`.
pub fn python() -> Result<PathBuf, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let home = root.join("target/rivals");
    let python = home.join("bin/python");
    let run = |command: &mut Command| match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("{command:?} ended with {status}")),
        Err(error) => Err(format!("{command:?}: {error}")),
    };
    if !python.is_file() {
        run(Command::new("python3").args(["-m", "venv"]).arg(&home))?;
    }
    let requirements = root.join("benches/rivals/requirements.txt");
    run(Command::new(&python).args(["-m", "pip", "install", "-q", "-r"]).arg(requirements))?;
    Ok(python)
}
