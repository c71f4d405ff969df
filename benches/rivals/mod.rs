//! What the benches share with their rivals in Python: the frames that both make, and the environment they run in.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use nightflow::wire::{Header, Image};

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

/// The night scene as a raw image, 12 of 16 bits, of a camera that has moved by so many pixels to the right.
pub fn image([width, height]: [u32; 2], moved: u32, seed: u32) -> Image {
    let bytes = (0..height).flat_map(|y| (0..width).flat_map(move |x| count(x + moved, y, seed).to_le_bytes()));
    Image {
        header: Header { frame_id: "camera".into(), ..Header::default() },
        height,
        width,
        encoding: "bayer_rggb16".into(),
        is_bigendian: 0,
        step: 2 * width,
        data: bytes.collect(),
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
