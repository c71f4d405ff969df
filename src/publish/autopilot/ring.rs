//! What is in the way as autopilots take it: 72 distances in centimetres around the vehicle, clockwise from its front.

use crate::{
    clock::Stamp,
    flow::State,
    motion::{NoSight, SECTORS, Sector},
    publish::Moved,
};

/// Nothing is known of the sector.
pub(super) const UNKNOWN: u16 = u16::MAX;
/// The nearest that is told; whatever is nearer is told as this. PX4's brake passes over what is not beyond the least
/// distance, and ArduPilot over what is below it.
pub(super) const LEAST_CM: u16 = MIN_CM + 1;
/// The least distance that messages name.
pub(super) const MIN_CM: u16 = 20;
/// Degrees from one distance to the next; the first looks forward.
pub(super) const INCREMENT_DEG: u8 = (360 / SECTORS) as u8;

/// Distances of one step, body frame with roll and pitch taken off. They stand for the newer frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Ring {
    pub(super) newer: Stamp,
    /// Centimetres; [`UNKNOWN`], or one more than `max_cm` where nothing is in the way up to there.
    pub(super) cm: [u16; SECTORS],
    pub(super) max_cm: u16,
}

impl Ring {
    /// What the step says up to `max_cm`; none where obstacles are not looked for.
    ///
    /// `max_cm` does not follow the vehicle's speed, because PX4 throws a distance away whose greatest differs from the
    /// last one's. So a sector that is free, but not as far as that, is unknown.
    pub(super) fn of(moved: &Moved, max_cm: u16) -> Option<Self> {
        let seen = match (&moved.state, &moved.obstacles) {
            (_, Err(NoSight::Off)) => return None,
            (State::Blind(_), _) | (_, Err(_)) => None,
            (_, Ok(found)) => found.speed.map(|speed| (found, speed)),
        };
        let mut ring = Self { newer: moved.newer, cm: [UNKNOWN; SECTORS], max_cm };
        if let Some((found, speed)) = seen {
            let free_cm = 100.0 * speed * found.horizon_s;
            for (k, sector) in found.sectors.iter().enumerate() {
                // Sector k looks 5°·(k − 36) to the left.
                ring.cm[(SECTORS + SECTORS / 2 - k) % SECTORS] = told(sector, free_cm, max_cm);
            }
        }
        Some(ring)
    }

    /// The same for PX4's collision prevention, which has 36 bins and asks for every second distance only: each of those
    /// speaks for its neighbours too. The nearest of them counts, and what is not known of all three is not free.
    pub(super) fn paired(&self) -> Self {
        let free = self.max_cm + 1;
        let mut ring = *self;
        for j in (0..SECTORS).step_by(2) {
            let three = [self.cm[(j + SECTORS - 1) % SECTORS], self.cm[j], self.cm[j + 1]];
            let nearest = three.into_iter().filter(|cm| *cm < free).min();
            let known = !three.contains(&UNKNOWN);
            ring.cm[j] = nearest.unwrap_or(if known { free } else { UNKNOWN });
        }
        ring
    }
}

fn told(sector: &Sector, free_cm: f64, max_cm: u16) -> u16 {
    match *sector {
        // Rounded down: nearer is the safe side.
        Sector::Occupied { distance_m, .. } if 100.0 * distance_m < f64::from(max_cm) + 1.0 => {
            ((100.0 * distance_m) as u16).max(LEAST_CM)
        }
        Sector::Occupied { distance_m, whole: true, .. } if distance_m.is_finite() => max_cm + 1,
        Sector::Free { .. } if free_cm >= f64::from(max_cm) => max_cm + 1,
        _ => UNKNOWN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        flow::{Cause, Grid},
        motion::{Integrated, Lack, NoFlow, Obstacles},
    };

    const MAX_CM: u16 = 1500;
    const FREE: u16 = MAX_CM + 1;

    fn moved(sectors: [Sector; SECTORS], speed: Option<f64>) -> Moved {
        let (older, newer) = (Stamp::from_ns(1_000_000_000), Stamp::from_ns(1_033_000_000));
        Moved {
            step: 0,
            older,
            newer,
            frame_id: "camera".into(),
            camera_size: [0; 2],
            grid: Grid::default(),
            gain: 1.0,
            raw_mean: 0.1,
            noise: None,
            noise_level: None,
            saturated_part: 0.0,
            confidence: 0.9,
            state: State::Ok,
            velocity: Err(Lack::Gyro),
            integrated: Integrated::without(older, newer, NoFlow::Blind),
            obstacles: Ok(Obstacles {
                older,
                newer,
                sectors,
                heading: [1.0, 0.0, 0.0],
                heading_sd_rad: 0.01,
                speed,
                horizon_s: 8.0,
                delay_s: 0.15,
            }),
        }
    }

    fn at(distance_m: f64) -> Sector {
        Sector::Occupied { ttc_s: 1.0, distance_m, confidence: 0.99, whole: true }
    }

    fn ring(k: usize, sector: Sector, speed: f64) -> [u16; SECTORS] {
        let mut sectors = [Sector::Unknown; SECTORS];
        sectors[k] = sector;
        Ring::of(&moved(sectors, Some(speed)), MAX_CM).unwrap().cm
    }

    #[test]
    fn each_direction_stands_where_autopilots_look_for_it() {
        // Azimuth in degrees to the left (FLU), and to the right (FRD).
        let directions = [
            ("ahead", 0, 0),
            ("left of ahead", 5, 355),
            ("right of ahead", -5, 5),
            ("left", 90, 270),
            ("right", -90, 90),
        ];
        let back = [("back", -180, 180), ("back, a little left", 175, 185), ("back, a little right", -175, 175)];
        for (name, left, right) in directions.into_iter().chain(back) {
            let cm = ring(((left + 180) / 5) as usize, at(6.0), 3.0);
            let told: Vec<usize> = (0..SECTORS).filter(|j| cm[*j] != UNKNOWN).collect();
            assert_eq!(told, [right as usize / usize::from(INCREMENT_DEG)], "{name}");
            assert_eq!(cm[told[0]], 600, "{name}");
        }
    }

    #[test]
    fn distances_are_held_within_what_can_be_told() {
        let partly = |distance_m| Sector::Occupied { ttc_s: 1.0, distance_m, confidence: 0.99, whole: false };
        let free = Sector::Free { confidence: 0.95 };
        // What is free is so up to 8 s of the speed.
        let cases = [
            ("rounded down", at(6.0199), 3.0, 601),
            ("touching", at(0.0), 3.0, LEAST_CM),
            ("behind us", at(-1.0), 3.0, LEAST_CM),
            ("too near", at(0.2), 3.0, LEAST_CM),
            ("at the end", at(15.009), 3.0, MAX_CM),
            ("beyond", at(15.02), 3.0, FREE),
            ("beyond sixteen bits", at(700.0), 3.0, FREE),
            ("beyond, something may hide before it", partly(15.1), 3.0, UNKNOWN),
            ("near, something may hide before it", partly(6.0), 3.0, 600),
            ("no distance", at(f64::NAN), 3.0, UNKNOWN),
            ("infinitely far", at(f64::INFINITY), 3.0, UNKNOWN),
            ("free as far as is told", free, 15.0 / 8.0, FREE),
            ("free, but not as far", free, 1.87, UNKNOWN),
            ("not seen", Sector::Unknown, 3.0, UNKNOWN),
        ];
        for (name, sector, speed, wanted) in cases {
            let cm = ring(36, sector, speed);
            assert_eq!(cm[0], wanted, "{name}");
            assert!(cm[1..].iter().all(|cm| *cm == UNKNOWN), "{name}");
        }
    }

    #[test]
    fn without_sight_or_speed_all_is_unknown_and_without_a_lookout_nothing_is_said() {
        let unknown = |moved: &Moved| Ring::of(moved, MAX_CM).unwrap().cm == [UNKNOWN; SECTORS];
        let seen = moved([at(6.0); SECTORS], Some(3.0));
        assert!(!unknown(&seen));
        assert!(unknown(&moved([at(6.0); SECTORS], None)), "times are no distances");
        assert!(unknown(&Moved { state: State::Blind(Cause::Frozen), ..seen.clone() }));
        assert!(unknown(&Moved { obstacles: Err(NoSight::Lack(Lack::Gyro)), ..seen.clone() }));
        assert_eq!(Ring::of(&Moved { obstacles: Err(NoSight::Off), ..seen }, MAX_CM), None);
    }

    #[test]
    fn px4_s_every_second_distance_speaks_for_its_neighbours() {
        let mut ring = Ring { newer: Stamp::from_ns(0), cm: [FREE; SECTORS], max_cm: MAX_CM };
        (ring.cm[5], ring.cm[11], ring.cm[12], ring.cm[20], ring.cm[21]) = (400, 700, 300, UNKNOWN, UNKNOWN);
        ring.cm[71] = 900;
        let paired = ring.paired().cm;
        assert_eq!((paired[4], paired[6]), (400, 400), "a pole in an odd sector is seen by both of its neighbours");
        assert_eq!((paired[10], paired[12]), (700, 300), "the nearest counts");
        assert_eq!((paired[18], paired[20], paired[22], paired[24]), (FREE, UNKNOWN, UNKNOWN, FREE));
        assert_eq!((paired[0], paired[70]), (900, 900), "round the front");
        assert!((1..SECTORS).step_by(2).all(|j| paired[j] == ring.cm[j]), "the others say their own");
    }
}
