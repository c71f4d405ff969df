//! The network's threads on cores of their own: which they may be, and the calling thread among them while it computes.

use super::{Config, Error, Provider};

/// Cores that a thread may run on, in rising order.
pub fn allowed() -> Vec<usize> {
    let set = current();
    // SAFETY: the index is below the set's size.
    (0..libc::CPU_SETSIZE as usize).filter(|core| unsafe { libc::CPU_ISSET(*core, &set) }).collect()
}

fn current() -> libc::cpu_set_t {
    // SAFETY: a set of cores is bits, of which none set is a value.
    let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
    // SAFETY: the set is as large as is said; 0 means the calling thread. If the call fails the set stays empty.
    unsafe { libc::sched_getaffinity(0, size_of::<libc::cpu_set_t>(), &raw mut set) };
    set
}

/// Whether the settings' cores can be had: as many as threads, each once, each one that this program may run on.
pub fn check(config: &Config) -> Result<(), Error> {
    let (cores, threads) = (&config.cores, config.threads.max(1));
    if cores.is_empty() {
        return Ok(());
    }
    let refused = |why: String| Err(Error::Cores { cores: cores.clone(), why });
    if config.provider != Provider::Cpu {
        return refused("expected none with another provider than cpu, whose threads are not the node's".into());
    }
    if cores.len() != threads {
        return refused(format!("expected a core for each of the {threads} threads"));
    }
    let allowed = allowed();
    if let Some(core) = cores.iter().find(|core| !allowed.contains(core)) {
        return refused(format!("{core} is none that this program may run on, expected of {allowed:?}"));
    }
    match cores.iter().enumerate().find(|(at, core)| cores[..*at].contains(core)) {
        Some((_, twice)) => refused(format!("{twice} is there twice, expected different ones")),
        None => Ok(()),
    }
}

/// How ONNX Runtime is told the cores of all its threads but the one that calls it: counted from 1, one after the other.
pub fn of_workers(cores: &[usize]) -> Option<String> {
    let workers: Vec<String> = cores.iter().skip(1).map(|core| (core + 1).to_string()).collect();
    (!workers.is_empty()).then(|| workers.join(";"))
}

/// The calling thread is on one core while this lives, and then where it was before: whatever threads the loop starts
/// between two steps must not inherit the core.
pub struct Pinned {
    before: libc::cpu_set_t,
}

impl Pinned {
    /// Puts the calling thread on the first of the cores; `None` where there are none, or where the cores that the program
    /// may run on were taken from it since it started: it then goes on wherever it may.
    pub fn to(cores: &[usize]) -> Option<Self> {
        let core = *cores.first()?;
        let before = current();
        // SAFETY: as in `current`.
        let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
        // SAFETY: `check` knows the core as one of the set's.
        unsafe { libc::CPU_SET(core, &mut set) };
        set_current(&set).then_some(Self { before })
    }
}

impl Drop for Pinned {
    fn drop(&mut self) {
        set_current(&self.before);
    }
}

fn set_current(set: &libc::cpu_set_t) -> bool {
    // SAFETY: the set is as large as is said and is only read; 0 means the calling thread.
    unsafe { libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), set) == 0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cores_that_cannot_be_had_are_named() {
        let config = |cores: &[usize], threads: usize| Config { cores: cores.to_vec(), threads, ..Config::default() };
        let own = allowed()[0];
        check(&config(&[], 2)).unwrap();
        check(&config(&[own], 1)).unwrap();
        let said = |config: &Config| check(config).unwrap_err().to_string();
        assert!(said(&config(&[own], 2)).contains("expected a core for each of the 2 threads"));
        assert!(said(&config(&[own, own], 2)).contains(&format!("{own} is there twice")));
        assert!(said(&config(&[own, 1023], 2)).contains("1023 is none that this program may run on, expected of ["));
        let other = Config { provider: Provider::OpenVino, ..config(&[own], 1) };
        assert!(said(&other).contains("another provider than cpu"));
        assert_eq!((of_workers(&[3]), of_workers(&[0, 1, 5])), (None, Some("2;6".into())));
    }

    #[test]
    fn the_thread_goes_back_to_where_it_was() {
        let before = allowed();
        let last = *before.last().unwrap();
        {
            let _pinned = Pinned::to(&[last]).unwrap();
            assert_eq!(allowed(), [last]);
        }
        assert_eq!(allowed(), before);
        assert!(Pinned::to(&[]).is_none());
    }
}
