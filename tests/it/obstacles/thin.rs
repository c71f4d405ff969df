//! Wires, rods and poles that no cell of the flow holds: told by their lines, or unknown, and never free.

use nalgebra::Vector3;
use nightflow::motion::{Lookout, Obstacles, Sector, obstacles};

use super::{Course, FIELD, FOCAL, HEIGHT, STEP_NS, STEP_S, close, ground, occupied, post, textured};

/// A dark line without ends through a point of the world along a direction.
struct Line {
    point: Vector3<f64>,
    along: Vector3<f64>,
}

impl Course {
    /// The developed older frame with lines 3 cm thick in it, every one with its own noise.
    fn draw(&mut self, lines: &[Line]) {
        let mut image = textured(self.older_ns.cast_unsigned());
        let plane = image.width * image.height;
        for line in lines {
            let nearest = line.point - self.position;
            let nearest = nearest - line.along * nearest.dot(&line.along);
            let back = (self.attitude.to_rotation_matrix().matrix() * Self::mount()).transpose();
            let (normal, toward) = (back * line.along.cross(&nearest).normalize(), back * nearest);
            for at in 0..plane {
                let pixel = [at % image.width, at / image.width].map(|i| 2.0 * i as f64 + 0.5);
                let ray = Vector3::new((pixel[0] - 319.5) / FOCAL, (pixel[1] - 239.5) / FOCAL, 1.0);
                let aside = (ray.dot(&normal) / ray.norm()).abs() * FOCAL / 2.0;
                let distance = toward.norm_squared() * ray.norm() / ray.dot(&toward);
                let half = 0.5 * 0.03 / distance * FOCAL / 2.0;
                let covered = (half + 0.5 - aside).clamp(0.0, (2.0 * half).min(1.0));
                if distance > 0.0 {
                    (0..3).for_each(|c| image.rgb[c * plane + at] -= 0.35 * covered as f32);
                }
            }
        }
        self.image = image;
    }

    /// The developed older frame, brighter by so much where a ray (second) from the camera (first) shows it.
    fn shade(&mut self, brighter: impl Fn(&Vector3<f64>, &Vector3<f64>) -> f64) {
        let mut image = textured(self.older_ns.cast_unsigned());
        let plane = image.width * image.height;
        for at in 0..plane {
            let pixel = [at % image.width, at / image.width].map(|i| 2.0 * i as f64 + 0.5);
            let optical = Vector3::new((pixel[0] - 319.5) / FOCAL, (pixel[1] - 239.5) / FOCAL, 1.0);
            let more = brighter(&self.position, &(self.attitude * (Self::mount() * optical))) as f32;
            (0..3).for_each(|c| image.rgb[c * plane + at] += more);
        }
        self.image = image;
    }

    fn flown(&mut self, count: usize, lines: &[Line]) -> Obstacles {
        for _ in 1..count {
            self.draw(lines);
            let _ = self.step();
        }
        self.draw(lines);
        self.step().unwrap()
    }

    fn swaying(self) -> Self {
        Course { rates: Vector3::new(0.05, -0.04, 0.1), ..self }
    }

    fn without_thin(self) -> Self {
        let config = obstacles::Config { thin: false, ..obstacles::Config::default() };
        Course { lookout: Lookout::new(&config).unwrap(), ..self }
    }
}

/// Across the track at x, so high over the ground.
fn wire(x: f64, height: f64) -> Line {
    Line { point: Vector3::new(x, 0.0, height), along: Vector3::y() }
}

fn free(found: &Obstacles) -> usize {
    FIELD.filter(|sector| matches!(found.sectors[*sector], Sector::Free { .. })).count()
}

#[test]
fn a_wire_is_not_free_from_the_beginning_and_timed_once_its_parallax_says() {
    for height in [3.7, 4.35] {
        let lines = [wire(14.0, height)];
        let mut course = Course::new(ground).swaying();
        let early = course.flown(4, &lines);
        assert_eq!(free(&early), 0, "{:?}", early.sectors);
        let late = course.flown(32, &lines);
        let left = (14.0 - course.position.x) / 3.0;
        for sector in 33..=39 {
            let (ttc, metres) = occupied(late.sectors[sector]).unwrap_or_else(|| panic!("{:?}", late.sectors[sector]));
            assert!(close(ttc, left, 0.1) && metres >= 0.9 * 3.0 * left, "{sector}: {ttc} s {metres} m, {left} s left");
        }
        let mut blind = Course::new(ground).swaying().without_thin();
        assert!(free(&blind.flown(36, &lines)) > 6, "what is seen around a wire calls it free");
    }
}

#[test]
fn a_wire_on_the_path_itself_shows_no_parallax_and_is_unknown() {
    let mut course = Course::new(ground).swaying();
    for _ in 0..40 {
        let found = course.flown(1, &[wire(14.0, HEIGHT)]);
        if course.older_ns > 10_000_000_000 + 3 * STEP_NS {
            assert_eq!(free(&found), 0, "{:?}", found.sectors);
        }
        let told = FIELD.filter_map(|sector| occupied(found.sectors[sector]).map(|(ttc, _)| ttc));
        let left = (14.0 - course.position.x) / 3.0;
        told.for_each(|ttc| assert!(close(ttc, left, 0.3), "{ttc} s, {left} s left"));
    }
}

#[test]
fn a_rod_is_in_its_own_sector() {
    let rod = Line { point: Vector3::new(14.0, 1.8, 0.0), along: Vector3::z() };
    let mut course = Course::new(ground);
    let found = course.flown(26, &[rod]);
    let ahead = 14.0 - course.position.x;
    let sector = 36 + (1.8_f64.atan2(ahead).to_degrees() / 5.0).round() as usize;
    let (ttc, _) = occupied(found.sectors[sector]).unwrap();
    assert!(close(ttc, ahead / 3.0, 0.05), "{ttc} s, {} s left", ahead / 3.0);
    assert!(free(&found) >= 8, "{:?}", &found.sectors[FIELD]);
}

#[test]
fn a_wire_that_is_flown_under_is_not_in_the_way() {
    let mut course = Course::new(ground).swaying();
    let found = course.flown(30, &[wire(16.0, 7.5)]);
    assert!(found.sectors.iter().all(|sector| occupied(*sector).is_none()), "{:?}", found.sectors);
    assert!(free(&found) > 6, "{:?}", found.sectors);
}

#[test]
fn steps_that_are_missing_make_a_wire_a_new_one() {
    let lines = [wire(14.0, 4.35)];
    let mut course = Course::new(ground);
    assert!(occupied(course.flown(32, &lines).sectors[36]).is_some());
    course.older_ns += STEP_NS;
    course.position += course.velocity * STEP_S;
    let found = course.flown(2, &lines);
    assert_eq!(occupied(found.sectors[36]), None, "its distance is not known yet");
    assert_eq!(free(&found), 0);
}

#[test]
fn a_pole_is_timed_by_its_edges_where_the_flow_shows_what_is_behind() {
    let pole = post([14.0, 1.8], 0.4, Vector3::z());
    let dark = |from: &Vector3<f64>, ray: &Vector3<f64>| match pole(from, ray) {
        Some((_, moves)) if moves.z > 0.0 => -0.2,
        _ => 0.0,
    };
    for thin in [true, false] {
        let mut course = Course::new(ground);
        if !thin {
            course = course.without_thin();
        }
        for _ in 0..25 {
            course.shade(dark);
            let _ = course.step();
        }
        course.shade(dark);
        let found = course.step().unwrap();
        let left = (14.0 - course.position.x) / 3.0;
        let sector = 36 + (1.8_f64.atan2(3.0 * left).to_degrees() / 5.0).round() as usize;
        let told = (sector - 1..=sector + 1).find_map(|sector| occupied(found.sectors[sector]));
        assert_eq!(told.is_some(), thin, "{:?}", &found.sectors[FIELD]);
        told.iter().for_each(|(ttc, _)| assert!(close(*ttc, left, 0.1), "{ttc} s, {left} s left"));
        assert!(free(&found) >= 8, "{:?}", &found.sectors[FIELD]);
    }
}

#[test]
fn the_horizon_hides_nothing() {
    let mut course = Course::new(ground).swaying();
    let sky = |_: &Vector3<f64>, ray: &Vector3<f64>| if ray.z > 0.0 { 0.2 } else { 0.0 };
    for _ in 0..20 {
        course.shade(sky);
        let _ = course.step();
    }
    course.shade(sky);
    let found = course.step().unwrap();
    assert!(free(&found) > 6, "{:?}", found.sectors);
}
