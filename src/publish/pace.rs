//! Fewer than every step, by the frames' own stamps.

use crate::clock::Stamp;

/// Lets steps through at most so often.
pub(super) struct Pace {
    period_ns: i64,
    due: Option<Stamp>,
    last: Option<Stamp>,
}

impl Pace {
    /// 0 holds nothing back.
    pub(super) fn new(hz: f64) -> Self {
        Self { period_ns: if hz > 0.0 { (1e9 / hz) as i64 } else { 0 }, due: None, last: None }
    }

    /// Whether it is time for what was seen at this stamp.
    pub(super) fn lets(&mut self, at: Stamp) -> bool {
        let wait_ns = self.due.map_or(0, |due| due.ns().saturating_sub(at.ns()));
        let since_ns = self.last.map_or(0, |last| at.ns().saturating_sub(last.ns()).max(0));
        self.last = Some(at);
        // What comes a little early or late does not move the beat, so that jitter costs nothing and adds nothing; but
        // where the next step will be nearer to the beat than this one, that one is waited for.
        let early_ns_max = (self.period_ns / 10).min(since_ns / 2);
        let on_beat = wait_ns <= early_ns_max && wait_ns >= -self.period_ns;
        // Late by more than a period is a hole, and early by more a camera that started anew: both begin anew.
        let lets = on_beat || wait_ns.saturating_abs() > self.period_ns;
        if lets {
            let beat_ns = if on_beat { at.ns().saturating_add(wait_ns) } else { at.ns() };
            self.due = Some(Stamp::from_ns(beat_ns.saturating_add(self.period_ns)));
        }
        lets
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pace_keeps_its_beat() {
        let told = |hz: f64, stamps_ms: &[i64]| -> Vec<i64> {
            let mut pace = Pace::new(hz);
            stamps_ms.iter().copied().filter(|ms| pace.lets(Stamp::from_ns(ms * 1_000_000))).collect()
        };
        let steps: Vec<i64> = (0..300).map(|i| i * 100 / 3).collect();
        assert_eq!(told(0.0, &steps).len(), 300);
        assert_eq!(told(10.0, &steps).len(), 100);
        assert_eq!(told(20.0, &steps).len(), 200, "also where the beat falls between steps");
        let fast: Vec<i64> = (0..100).map(|i| i * 20).collect();
        assert_eq!(told(2.0, &fast), [0, 500, 1000, 1500], "and where steps are many, none comes early");
        assert_eq!(told(10.0, &[0, 80, 99, 101, 210, 280, 300]), [0, 99, 210, 300], "jitter does not move it");
        assert_eq!(told(10.0, &[0, 100, 5000, 5010, 5100]), [0, 100, 5000, 5100], "after a hole it begins anew");
        assert_eq!(told(10.0, &[5000, 100, 150, 200]), [5000, 100, 200], "and where the camera started anew");
    }
}
