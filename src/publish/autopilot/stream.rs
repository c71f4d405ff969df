//! Steps joined into the spans that an autopilot is told of: nothing of the time between is lost or told twice.

use crate::{clock::Stamp, motion::Integrated};

/// A stamp as autopilots count: microseconds, in the clock that the offset leads to.
pub(super) fn stamp_us(stamp: Stamp, offset_us: i64) -> u64 {
    u64::try_from(stamp.ns().div_euclid(1000).saturating_add(offset_us)).unwrap_or(0)
}

/// The flow over one or more steps that follow each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Span {
    pub(super) older: Stamp,
    pub(super) newer: Stamp,
    /// rad, FRD; none where it can't be trusted.
    pub(super) flow: Option<[f64; 2]>,
    /// rad, FRD, over the same interval.
    pub(super) gyro: Option<[f64; 3]>,
    /// Metres, the newest that is known.
    pub(super) distance: Option<f64>,
    pub(super) focal_px: Option<f64>,
    /// The least of the steps.
    pub(super) quality: u8,
}

impl From<&Integrated> for Span {
    fn from(step: &Integrated) -> Self {
        Self {
            older: step.older,
            newer: step.newer,
            flow: step.flow.ok(),
            gyro: step.gyro,
            distance: step.distance,
            focal_px: step.focal_px,
            quality: step.quality,
        }
    }
}

impl Span {
    /// Seconds.
    pub(super) fn seconds(&self) -> f64 {
        self.newer.seconds_since(self.older)
    }

    /// Whole microseconds, so that the spans of a series sum to the time between its ends.
    pub(super) fn micros(&self) -> u32 {
        let micros = self.newer.ns().div_euclid(1000) - self.older.ns().div_euclid(1000);
        micros.clamp(0, u32::MAX.into()) as u32
    }

    /// The newer frame's, see [`stamp_us`].
    pub(super) fn stamp_us(&self, offset_us: i64) -> u64 {
        stamp_us(self.newer, offset_us)
    }

    /// Both, or `None` where they do not join: a hole between them, or one knows what the other does not.
    fn joined(&self, next: &Span) -> Option<Span> {
        let alike = self.flow.is_some() == next.flow.is_some() && self.gyro.is_some() == next.gyro.is_some();
        (self.newer == next.older && alike).then(|| Span {
            older: self.older,
            flow: self.flow.zip(next.flow).map(|(a, b)| std::array::from_fn(|i| a[i] + b[i])),
            gyro: self.gyro.zip(next.gyro).map(|(a, b)| std::array::from_fn(|i| a[i] + b[i])),
            distance: next.distance.or(self.distance),
            focal_px: next.focal_px.or(self.focal_px),
            quality: self.quality.min(next.quality),
            ..*next
        })
    }
}

/// Joins steps until a span is as long as the rate allows.
pub(super) struct Stream {
    period_s: f64,
    open: Option<Span>,
}

impl Stream {
    /// At most `hz` spans a second while all is well; 0 joins nothing.
    pub(super) fn new(hz: f64) -> Self {
        Self { period_s: if hz > 0.0 { 1.0 / hz } else { 0.0 }, open: None }
    }

    /// Takes a step. Gives the span before it where the step does not continue it, and the one that it completes.
    pub(super) fn take(&mut self, step: &Integrated) -> [Option<Span>; 2] {
        let step = Span::from(step);
        let (broken, span) = match self.open.take() {
            None => (None, step),
            Some(open) => match open.joined(&step) {
                Some(both) => (None, both),
                None => (Some(open), step),
            },
        };
        // A microsecond's leeway keeps 30 Hz at 10 from being 7.5.
        let complete = span.seconds() + 1e-6 >= self.period_s;
        self.open = (!complete).then_some(span);
        [broken, complete.then_some(span)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::NoFlow;

    fn step(index: i64, flow: Option<f64>) -> Integrated {
        let at = |index: i64| Stamp::from_ns(index * 33_333_333);
        let none = Integrated::without(at(index), at(index + 1), NoFlow::Blind);
        match flow {
            Some(x) => Integrated { flow: Ok([x, -x]), gyro: Some([x, 0.0, 1.0]), quality: 100 + index as u8, ..none },
            None => Integrated { gyro: Some([0.0; 3]), ..none },
        }
    }

    #[test]
    fn steps_are_joined_until_the_rate_allows_one() {
        let mut stream = Stream::new(10.0);
        let spans: Vec<Span> = (0..9).flat_map(|i| stream.take(&step(i, Some(0.01)))).flatten().collect();
        assert_eq!(spans.len(), 3);
        for (i, span) in spans.iter().enumerate() {
            let [x, y] = span.flow.unwrap();
            assert!((x - 0.03).abs() < 1e-12 && (y + 0.03).abs() < 1e-12, "{span:?}");
            assert_eq!((span.gyro.unwrap()[2], span.quality), (3.0, 100 + 3 * i as u8), "{span:?}");
        }
        assert_eq!(spans.iter().map(|span| u64::from(span.micros())).sum::<u64>(), 9 * 33_333_333 / 1000);
    }

    #[test]
    fn what_is_blind_never_joins_what_is_not() {
        let mut stream = Stream::new(10.0);
        let flows = [Some(0.01), Some(0.01), None, None, None, Some(0.02), Some(0.02), Some(0.02)];
        let spans: Vec<Span> =
            flows.iter().enumerate().flat_map(|(i, flow)| stream.take(&step(i as i64, *flow))).flatten().collect();
        let told: Vec<(Option<f64>, bool)> =
            spans.iter().map(|span| (span.flow.map(|[x, _]| (x * 1e3).round()), span.quality > 0)).collect();
        assert_eq!(told, [(Some(20.0), true), (None, false), (Some(60.0), true)]);
        assert!(spans.windows(2).all(|pair| pair[0].newer == pair[1].older), "{spans:?}");
    }

    #[test]
    fn a_hole_ends_a_span() {
        let mut stream = Stream::new(10.0);
        assert_eq!(stream.take(&step(0, Some(0.01))), [None, None]);
        let [broken, complete] = stream.take(&step(5, Some(0.01)));
        assert_eq!((broken.map(|span| span.micros()), complete), (Some(33_333), None));
        let mut every = Stream::new(0.0);
        assert!(matches!(every.take(&step(0, None)), [None, Some(Span { flow: None, quality: 0, .. })]));
    }
}
