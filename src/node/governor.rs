//! Keeps the camera's rate: where steps take longer than frames are apart, images are developed narrower, in stated steps.
//!
//! It looks at the share of the time between two frames that a step takes, and lowers the width when that is too much: to the
//! widest step that fits by the area of what the network gets. It widens again when the next wider step would have fitted
//! for a while with room to spare; each time that turns out wrong it waits twice as long before it tries again. No frame
//! waits meanwhile: those that come too soon are displaced by newer ones, as ever.

use std::fmt;

use crate::{
    clock::Stamp,
    exposure,
    // Narrower steps than this save nothing.
    flow::padding::{STRIDE as STEP, padded},
};

/// A greater share of the time between two frames is too much, …
const SHARE_MAX: f64 = 0.95;
/// … and this is what a narrower width must fit into, so that it need not be narrowed at once again.
const SHARE_FITTING: f64 = 0.85;
/// A wider width must have fitted into this for as long as patience lasts.
const SHARE_WIDER: f64 = 0.75;
/// Weight of the newest step in the smoothed share: ten steps, and all of them while there are fewer.
const SMOOTHING: f64 = 0.1;
/// After a change the share is believed after this many steps, of which the first takes memory and does not count, …
const SETTLING: u32 = 5;
/// … and after this long, seconds.
const SETTLING_S: f64 = 0.5;
/// Patience before widening, seconds, at first and at most.
const PATIENCE_S: [f64; 2] = [5.0, 80.0];
/// A narrowing so soon after a widening says that the widening was wrong, seconds.
const REGRET_S: f64 = 10.0;
/// A longer time between frames is a pause of the camera and says nothing about its rate, seconds.
const PAUSE_S: f64 = 1.0;

/// Chooses the width of the images.
#[derive(Debug)]
pub struct Governor {
    /// From the widest to the narrowest.
    widths: Vec<usize>,
    at: usize,
    newest: Option<(Stamp, u64)>,
    /// Smoothed seconds between two of the camera's frames, and of a step.
    period_s: Option<f64>,
    step_s: Option<f64>,
    settled: u32,
    settled_s: f64,
    fitted_s: f64,
    since_widened_s: f64,
    patience_s: f64,
}

/// One step, as the governor sees it.
#[derive(Debug, Clone, Copy)]
pub struct Taken {
    /// Of the newer frame.
    pub stamp: Stamp,
    /// Frames that were displaced since the start.
    pub displaced: u64,
    /// How long the step took, seconds.
    pub step_s: f64,
    /// Columns and rows of the developed image.
    pub size: [usize; 2],
}

/// Why images are narrower than they could be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Narrowed {
    /// Columns now.
    pub columns: usize,
    /// Columns by the settings.
    pub of: usize,
    /// The camera's rate.
    pub hz: f64,
}

impl fmt::Display for Narrowed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "images are {} of {} columns wide to keep {:.1} Hz", self.columns, self.of, self.hz)
    }
}

impl Governor {
    /// For these settings; none where `width_min` is unset or leaves nothing to choose.
    pub fn new(config: &exposure::Config) -> Option<Self> {
        let least = config.width_min?;
        let mut widths = vec![config.width_max];
        widths.extend(
            (1..=config.width_max / STEP).rev().map(|k| k * STEP).filter(|&w| w >= least && w < config.width_max),
        );
        (widths.len() > 1).then_some(Self {
            widths,
            at: 0,
            newest: None,
            period_s: None,
            step_s: None,
            settled: 0,
            settled_s: 0.0,
            fitted_s: 0.0,
            since_widened_s: f64::INFINITY,
            patience_s: PATIENCE_S[0],
        })
    }

    /// Takes note of a step; a width where it has to change.
    pub fn took(&mut self, taken: &Taken) -> Option<usize> {
        let newest = self.newest.replace((taken.stamp, taken.displaced));
        let (before, displaced) = newest?;
        let passed_s = taken.stamp.seconds_since(before);
        if !(passed_s > 0.0 && passed_s <= PAUSE_S) {
            return None;
        }
        let frames = 1 + taken.displaced.saturating_sub(displaced);
        let smooth = |kept: &mut Option<f64>, new: f64, weight: f64| {
            let value = kept.map_or(new, |kept| kept + weight * (new - kept));
            *kept = Some(value);
            value
        };
        let period_s = smooth(&mut self.period_s, passed_s / frames as f64, SMOOTHING);
        self.since_widened_s += passed_s;
        self.settled_s += passed_s;
        self.settled += 1;
        if self.settled == 1 {
            return None;
        }
        let step_s = smooth(&mut self.step_s, taken.step_s, SMOOTHING.max(1.0 / f64::from(self.settled - 1)));
        if self.settled < SETTLING || self.settled_s < SETTLING_S {
            return None;
        }
        let share = |width: usize| step_s / period_s * area(width, taken.size) / area(self.widths[self.at], taken.size);
        if share(self.widths[self.at]) > SHARE_MAX {
            let narrower = self.at + 1..self.widths.len();
            let fitting = narrower.clone().find(|&at| share(self.widths[at]) <= SHARE_FITTING);
            let to = fitting.or(narrower.last())?;
            if self.since_widened_s < REGRET_S {
                self.patience_s = (2.0 * self.patience_s).min(PATIENCE_S[1]);
            }
            return Some(self.change(to));
        }
        let wider = self.at.checked_sub(1).filter(|&wider| share(self.widths[wider]) <= SHARE_WIDER);
        let Some(wider) = wider else {
            self.fitted_s = 0.0;
            return None;
        };
        self.fitted_s += passed_s;
        if self.fitted_s < self.patience_s {
            return None;
        }
        self.since_widened_s = 0.0;
        Some(self.change(wider))
    }

    fn change(&mut self, to: usize) -> usize {
        (self.at, self.step_s, self.fitted_s) = (to, None, 0.0);
        (self.settled, self.settled_s) = (0, 0.0);
        self.widths[to]
    }

    /// What it holds the images down to, if it does.
    pub fn narrowed(&self) -> Option<Narrowed> {
        let hz = 1.0 / self.period_s?;
        (self.at > 0).then_some(Narrowed { columns: self.widths[self.at], of: self.widths[0], hz })
    }
}

/// Pixels that the network gets for an image of this width, padded to whole steps.
fn area(width: usize, [columns, rows]: [usize; 2]) -> f64 {
    let rows = (width * rows).div_ceil(columns.max(1));
    (padded(width, STEP) * padded(rows, STEP)) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera of `hz` and a machine on which a pixel takes `ns`, for so many seconds; every change with its time.
    fn run(governor: &mut Governor, from_s: f64, seconds: f64, hz: f64, ns: impl Fn(f64) -> f64) -> Vec<(f64, usize)> {
        let (mut now, mut displaced, mut changes) = (from_s, 0, vec![]);
        while now < from_s + seconds {
            let width = governor.widths[governor.at];
            let size = [width, width * 3 / 4];
            let step_s = area(width, size) * ns(now) * 1e-9;
            // The next frame to be taken is the newest when the step is done.
            let frames = (step_s * hz).ceil().max(1.0);
            displaced += frames as u64 - 1;
            now += frames / hz;
            let taken = Taken { stamp: Stamp::from_ns((now * 1e9) as i64), displaced, step_s, size };
            changes.extend(governor.took(&taken).map(|width| (now, width)));
        }
        changes
    }

    fn governor() -> Governor {
        let config = exposure::Config { width_min: Some(128), ..exposure::Config::default() };
        Governor::new(&config).unwrap()
    }

    #[test]
    fn it_is_there_only_where_there_is_something_to_choose() {
        assert!(Governor::new(&exposure::Config::default()).is_none());
        let of = |width_min| Governor::new(&exposure::Config { width_min: Some(width_min), ..Default::default() });
        assert_eq!(of(192).unwrap().widths, [320, 256, 192]);
        assert!(of(320).is_none());
    }

    #[test]
    fn what_fits_is_left_alone_and_what_does_not_is_narrowed_once() {
        let mut governor = governor();
        // 320 × 256 take 25 ms of 33.
        assert_eq!(run(&mut governor, 0.0, 60.0, 30.0, |_| 300.0), []);
        assert_eq!(governor.narrowed(), None);
        // 49 ms now; 256 × 192 take 29.5.
        let changes = run(&mut governor, 60.0, 60.0, 30.0, |_| 600.0);
        assert!(matches!(changes[..], [(at, 256)] if at < 65.0), "{changes:?}");
        let narrowed = governor.narrowed().unwrap();
        assert_eq!(narrowed.to_string(), "images are 256 of 320 columns wide to keep 30.0 Hz");
    }

    #[test]
    fn it_widens_when_there_is_room_again_and_goes_to_the_least_where_nothing_fits() {
        let mut governor = governor();
        let changes = run(&mut governor, 0.0, 20.0, 30.0, |_| 5000.0);
        assert!(matches!(changes[..], [(_, 128)]), "{changes:?}");
        let changes = run(&mut governor, 20.0, 60.0, 30.0, |_| 200.0);
        assert_eq!(changes.iter().map(|change| change.1).collect::<Vec<_>>(), [192, 256, 320], "{changes:?}");
        assert_eq!(governor.narrowed(), None);
    }

    #[test]
    fn a_width_that_keeps_failing_is_tried_ever_more_seldom() {
        let mut governor = governor();
        // What narrower images take says too little about wider ones here: 320 columns take half as much again.
        let heavy = std::cell::Cell::new(320);
        let mut changes = vec![];
        let mut now = 0.0;
        for _ in 0..3000 {
            heavy.set(governor.widths[governor.at]);
            let ns = if heavy.get() == 320 { 600.0 } else { 300.0 };
            changes.extend(run(&mut governor, now, 0.2, 30.0, |_| ns));
            now += 0.2;
        }
        let widened: Vec<f64> = changes.iter().filter(|change| change.1 == 320).map(|change| change.0).collect();
        let pauses: Vec<f64> = widened.windows(2).map(|pair| pair[1] - pair[0]).collect();
        assert!(pauses.len() > 5 && pauses[0] < 25.0 && pauses[3..].iter().all(|pause| *pause > 79.0), "{pauses:?}");
    }

    #[test]
    fn pauses_and_clocks_that_go_back_say_nothing() {
        let mut governor = governor();
        for second in [0_i64, 5, 3, 60, 61] {
            let stamp = Stamp::from_ns(second * 1_000_000_000);
            let taken = Taken { stamp, displaced: 0, step_s: 9.0, size: [320, 240] };
            assert_eq!(governor.took(&taken), None);
        }
    }
}
