//! What the frames' gradients say of every cell: it outweighs what vectors lack, counts by its texture, and says how well it knows.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use nightflow::{
    darkness::noise::Normals,
    flow::Gradients,
    motion::{Lack, Velocity},
};

use super::{GRID, OLDER_NS, SIZE, Seen, Truth};

/// Five planes, of cells with these informations whose likelihood is greatest at `best`.
struct Said(Vec<f32>);

impl Said {
    fn of(seen: &Seen, best: &[f32], information: impl Fn(usize) -> Matrix2<f64>) -> Self {
        let mut planes = vec![0.0; 5 * GRID.cells()];
        for cell in 0..GRID.cells() {
            let known = information(cell);
            let step = |axis: usize| f64::from(best[2 * cell + axis] - seen.vectors[2 * cell + axis]);
            let pull = known * Vector2::new(step(0), step(1));
            for (plane, value) in [known.m11, known.m12, known.m22, pull.x, pull.y].into_iter().enumerate() {
                planes[plane * GRID.cells() + cell] = value as f32;
            }
        }
        Self(planes)
    }

    fn told(&self) -> Gradients<'_> {
        let plane = |at: usize| self.0.get(at * GRID.cells()..(at + 1) * GRID.cells()).unwrap_or_default();
        Gradients { information: [plane(0), plane(1), plane(2)], pull: [plane(3), plane(4)] }
    }
}

fn velocity(truth: &Truth, seen: &Seen, said: Option<&Said>) -> Result<Velocity, Lack> {
    let gyro = (-4..12).map(|k| OLDER_NS + 1_234_567 + k * 5_000_000);
    truth.odometer(seen, gyro, true).velocity_with(&truth.flow(seen), said.map(Said::told), SIZE)
}

fn flying() -> Truth {
    let mut truth = Truth::hovering(6.0);
    truth.velocity = Vector3::new(2.0, -0.7, 0.3);
    truth
}

fn off(truth: &Truth, found: &Velocity) -> f64 {
    (Vector3::from(found.linear) - truth.expected()).norm()
}

#[test]
fn what_all_vectors_lack_is_made_good() {
    let truth = flying();
    let exact = truth.exact();
    let short = Seen { vectors: exact.vectors.iter().map(|v| 0.9 * v).collect(), ..truth.exact() };
    let said = Said::of(&short, &exact.vectors, |_| Matrix2::identity() * 4.0);
    let [plain, heard] = [None, Some(&said)].map(|said| off(&truth, &velocity(&truth, &short, said).unwrap()));
    assert!(plain > 0.1, "a tenth of the speed is missing: {plain}");
    // Rays are taken at the vectors as they are, which matters to second order.
    assert!(heard < 0.005 * plain, "{heard} m/s off");
}

#[test]
fn along_an_edge_a_cell_says_nothing() {
    let truth = flying();
    let exact = truth.exact();
    let mut draws = Normals::new(5, 0);
    let edges: Vec<Vector2<f64>> = (0..GRID.cells())
        .map(|_| {
            let angle = std::f64::consts::TAU * draws.uniform();
            Vector2::new(angle.cos(), angle.sin())
        })
        .collect();
    // Vectors err along the edge that their cell shows, by two pixels or so.
    let mut along = truth.exact();
    for (vector, edge) in along.vectors.as_chunks_mut::<2>().0.iter_mut().zip(&edges) {
        let wrong = 2.0 * draws.draw();
        (vector[0], vector[1]) = (vector[0] + (wrong * edge.x) as f32, vector[1] + (wrong * edge.y) as f32);
    }
    let across = |cell: usize| Vector2::new(-edges[cell].y, edges[cell].x);
    let said = Said::of(&along, &exact.vectors, |cell| across(cell) * across(cell).transpose());
    let [plain, heard] = [None, Some(&said)].map(|said| off(&truth, &velocity(&truth, &along, said).unwrap()));
    assert!(plain > 0.01 && heard < 0.01 * plain, "{plain} by the vectors, {heard} by what their cells know");
}

#[test]
fn where_gradients_say_nothing_the_vectors_have_the_word() {
    let truth = flying();
    let exact = truth.exact();
    let plain = velocity(&truth, &exact, None).unwrap();
    let nothing = Said(vec![0.0; 5 * GRID.cells()]);
    let torn = Said(vec![1.0; 7]);
    let odd = Said(vec![f32::NAN; 5 * GRID.cells()]);
    // One direction alone is no motion.
    let one = Said::of(&exact, &exact.vectors, |_| Matrix2::new(1.0, 0.0, 0.0, 0.0));
    for (name, said) in [("zeros", nothing), ("too few", torn), ("no numbers", odd), ("one direction", one)] {
        assert_eq!(velocity(&truth, &exact, Some(&said)).unwrap(), plain, "{name}");
    }
    let mut deaf = flying();
    deaf.config.gradients = false;
    let wrong = Said::of(&exact, &vec![0.0; 2 * GRID.cells()], |_| Matrix2::identity());
    assert_eq!(velocity(&deaf, &exact, Some(&wrong)).unwrap(), plain);
    assert!(off(&truth, &velocity(&truth, &exact, Some(&wrong)).unwrap()) > 0.1, "who listens is told something else");
}

#[test]
fn what_moves_on_its_own_is_not_heard() {
    let truth = flying();
    let mut seen = truth.exact();
    let exact = truth.exact().vectors;
    // A third of the view goes elsewhere, with more texture than the ground.
    let other = |cell: usize| cell % GRID.width < GRID.width / 3;
    for cell in (0..GRID.cells()).filter(|cell| other(*cell)) {
        seen.vectors[2 * cell] += 25.0;
    }
    let best: Vec<f32> = seen.vectors.clone();
    let said = Said::of(&seen, &best, |cell| Matrix2::identity() * if other(cell) { 50.0 } else { 1.0 });
    assert_eq!(best[2 * (GRID.width / 2)], exact[2 * (GRID.width / 2)]);
    let error = off(&truth, &velocity(&truth, &seen, Some(&said)).unwrap());
    assert!(error < 1e-4, "{error} m/s off");
}

/// Cells of unlike texture whose pulls are noisy as their information says, and no other error: the covariance is as large as the errors.
#[test]
fn the_covariance_is_that_of_the_cells_own_noise() {
    let mut truth = flying();
    let config = &mut truth.config;
    (config.gyro_sd_rad_s, config.gyro_bias_sd_rad_s, config.attitude_sd_rad) = (1e-6, 0.0, 1e-7);
    (config.range_sd_m, config.range_sd_part, config.climb_sd_m_s) = (1e-6, 0.0, 0.0);
    (config.flow_shared_sd_cells, config.flow_shared_sd_part, config.flow_bend_sd_cells) = (0.0, 0.0, 0.0);
    (config.ground_bend_sd, config.ground_slope_sd, config.ground_relief_sd) = (0.0, 0.0, 0.0);
    let mut seen = truth.exact();
    let (mut draws, mut sum) = (Normals::new(9, 0), 0.0);
    // Vectors that scatter so much have no say.
    let scatter: Vec<f32> = seen.vectors.iter().map(|_| (3.0 * draws.draw()) as f32).collect();
    seen.vectors.iter_mut().zip(&scatter).for_each(|(vector, off)| *vector += off);
    const DRAWS: usize = 150;
    for _ in 0..DRAWS {
        let mut planes = vec![0.0; 5 * GRID.cells()];
        for cell in 0..GRID.cells() {
            let (angle, strong) = (std::f64::consts::PI * draws.uniform(), 0.2 + 5.0 * draws.uniform());
            let (sine, cosine) = angle.sin_cos();
            let turn = Matrix2::new(cosine, -sine, sine, cosine);
            let known = turn * Matrix2::new(strong, 0.0, 0.0, 0.1 * strong) * turn.transpose();
            let noise = turn * Vector2::new(strong.sqrt() * draws.draw(), (0.1 * strong).sqrt() * draws.draw());
            let off = Vector2::new(scatter[2 * cell].into(), scatter[2 * cell + 1].into());
            let pull = noise - known * off;
            let values = [known.m11, known.m12, known.m22, pull.x, pull.y];
            for (plane, value) in values.into_iter().enumerate() {
                planes[plane * GRID.cells() + cell] = value as f32;
            }
        }
        let found = velocity(&truth, &seen, Some(&Said(planes))).unwrap();
        let error = Vector3::from(found.linear) - truth.expected();
        let covariance = Matrix3::from_fn(|i, j| found.covariance[i][j]);
        sum += (error.transpose() * covariance.try_inverse().unwrap() * error)[0] / 3.0;
    }
    let mean = sum / DRAWS as f64;
    println!("normalised error squared over its degrees of freedom: {mean:.3}");
    // More is said than there is: these cells know their information, those of frames do not, which counts for 15 %; and how alike errors
    // are is never taken for less than not at all.
    assert!((0.6..=1.25).contains(&mean), "{mean}");
}
