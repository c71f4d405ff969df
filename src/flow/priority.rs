//! Real-time priority: the frame's road before everything else that wants the same cores.
//!
//! A step of two threads is as late as the one that another program pushed aside. Under the ordinary policy everybody who
//! wakes gets a turn at once, and a few milliseconds of a daemon in every hundred are enough to make one frame in a hundred
//! late by half (README, camera's stamp to flow in another's hands). Under `SCHED_FIFO` nobody ordinary gets in between; the
//! kernel still keeps a twentieth of every second for them (sched(7), `sched_rt_runtime_us`).

use super::{Config, Error};

/// The rule by which the system gives the calling thread its cores.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// Everybody in turns.
    Ordinary,
    /// Before all ordinary threads, and after real-time ones of greater numbers.
    RealTime(u8),
}

/// The calling thread's policy.
pub fn current() -> Policy {
    let mut given = libc::sched_param { sched_priority: 0 };
    // SAFETY: 0 means the calling thread, and the numbers are written where there is room for them.
    let policy = unsafe {
        libc::sched_getparam(0, &raw mut given);
        libc::sched_getscheduler(0)
    };
    match policy & !libc::SCHED_RESET_ON_FORK {
        libc::SCHED_FIFO | libc::SCHED_RR => Policy::RealTime(u8::try_from(given.sched_priority).unwrap_or(u8::MAX)),
        _ => Policy::Ordinary,
    }
}

/// Gives the calling thread, and with it all that it starts from now on, the settings' priority.
///
/// # Errors
/// Where it is out of range or the system refuses; the thread then is as it was.
pub fn take(config: &Config) -> Result<(), Error> {
    let priority = config.priority;
    if priority == 0 {
        return Ok(());
    }
    let refused = |why: String| Err(Error::Priority { priority, why });
    if priority > 99 {
        return refused("expected 1 to 99, or 0 for none".into());
    }
    set(libc::SCHED_FIFO, priority).or_else(|why| {
        refused(format!(
            "{why}; allow it: LimitRTPRIO={priority} in the service, `rtprio` in limits.conf, or CAP_SYS_NICE"
        ))
    })
}

/// Makes the calling thread an ordinary one again: for work that may wait, started by a thread that may not.
pub fn leave() {
    if current() != Policy::Ordinary {
        // Less than one has is never refused.
        let _ = set(libc::SCHED_OTHER, 0);
    }
}

fn set(policy: libc::c_int, priority: u8) -> std::io::Result<()> {
    let given = libc::sched_param { sched_priority: priority.into() };
    // SAFETY: 0 means the calling thread, and the numbers are only read.
    match unsafe { libc::sched_setscheduler(0, policy, &raw const given) } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_priority_that_no_system_has_is_refused() {
        let said = take(&Config { priority: 100, ..Config::default() }).unwrap_err().to_string();
        assert_eq!(said, "[flow] priority = 100: expected 1 to 99, or 0 for none");
        assert_eq!(current(), Policy::Ordinary);
    }
}
