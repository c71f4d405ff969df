//! What the figures were measured on: processor, how busy it was, and how much memory a process holds.

use std::fs;

/// Above this part of the cores waiting for work of others, figures are called `busy`.
const BUSY: f64 = 0.25;

/// The processor's name and how many cores this process may use.
pub fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    // x86 names the model; ARM's kernels name it only sometimes, and some boards name themselves.
    let named = |key: &str| {
        let line = text.lines().find(|line| line.split(':').next().is_some_and(|found| found.trim() == key))?;
        Some(line.split_once(':')?.1.trim().to_owned()).filter(|name| !name.is_empty())
    };
    let name = ["model name", "Model", "Hardware"].into_iter().find_map(named);
    let name = name.unwrap_or_else(|| format!("an unnamed {} processor", std::env::consts::ARCH));
    format!("{name}, {} cores", cores())
}

/// What else wants the cores, in words; to be asked before anything is measured.
pub fn load() -> String {
    let text = fs::read_to_string("/proc/loadavg").unwrap_or_default();
    match text.split(' ').next().and_then(|word| word.parse::<f64>().ok()) {
        Some(load) if load > BUSY * cores() as f64 => {
            format!("load {load:.1} at start: the machine was busy, take ratios seriously and milliseconds not")
        }
        Some(load) => format!("load {load:.1} at start"),
        None => "load at start unknown".into(),
    }
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Resident memory of a process, MiB.
pub fn resident(process: u32) -> Option<f64> {
    let text = fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    line.split_whitespace().next()?.parse::<f64>().ok().map(|kib| kib / 1024.0)
}

/// Resident memory of this process, MiB, without what the allocator keeps for later: it would hide how much comes next.
pub fn settled() -> Option<f64> {
    // SAFETY: it takes a number, gives pages back that nobody uses, and may be called at any time from any thread.
    #[cfg(target_env = "gnu")]
    unsafe {
        libc::malloc_trim(0);
    }
    resident(std::process::id())
}
