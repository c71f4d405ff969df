//! Noise is measured as strong as it was made: one level for an image, and (a, b) for a plane.

use nightflow::{
    camera::Sample,
    darkness::{
        flight::{self, Flight, Settings},
        level::{noise_level, noise_level_rgb},
        noise::Normals,
    },
};

const SIZE: [usize; 2] = [240, 180];

/// Clean pictures of the synthetic ground, red, green and blue, linear with a mean of about 0.35: rendered four times as
/// large as [`SIZE`] and averaged, sharp at the left and more and more out of focus to the right, as a photograph has its near and far.
fn pictures(count: usize) -> Vec<[Vec<f32>; 3]> {
    let settings = |index: usize| Settings {
        seed: 40 + index as u64,
        height: [3.0, 8.0, 20.0][index % 3],
        size: SIZE.map(|side| 4 * side),
        mean: [0.35, 0.35],
        noise: None,
        ..Settings::default()
    };
    (0..count).map(|index| averaged(settings(index)).map(|plane| focused(&plane))).collect()
}

/// A row and column of 1 2 1 over all that lies right of each sixth of the picture, twice as often with every sixth.
fn focused(plane: &[f32]) -> Vec<f32> {
    let [width, height] = SIZE;
    let mut plane = plane.to_vec();
    for (sixth, times) in [(1, 1), (2, 2), (3, 4), (4, 8), (5, 16)] {
        for _ in 0..times {
            for stride in [1, width] {
                let before = plane.clone();
                for at in (0..height - 1).flat_map(|row| (sixth * width / 6..width - 1).map(move |x| row * width + x)) {
                    let behind = before[at.saturating_sub(stride)];
                    plane[at] = 0.25 * behind + 0.5 * before[at] + 0.25 * before[at + stride];
                }
            }
        }
    }
    plane
}

/// Every plane's four pixels in four by four of the mosaic, averaged.
fn averaged(settings: Settings) -> [Vec<f32>; 3] {
    let [columns, rows] = settings.size;
    let shot = Flight::new(settings).unwrap().next().unwrap();
    let Some(Sample::Frame(frame)) = shot.samples.last() else { panic!("no frame") };
    let span = f32::from(flight::WHITE - flight::BLACK);
    let mut planes = [(); 3].map(|()| vec![0.0; columns * rows / 16]);
    for (at, count) in frame.image.data.as_chunks::<2>().0.iter().enumerate() {
        let (column, row) = (at % columns, at / columns);
        let value = (f32::from(u16::from_le_bytes(*count)) - f32::from(flight::BLACK)) / span;
        let (colour, share) = [(0, 4.0), (1, 8.0), (2, 4.0)][column % 2 + row % 2];
        planes[colour][row / 4 * (columns / 4) + column / 4] += value / share;
    }
    planes
}

fn noisy(clean: &[f32], sd: f64, draws: &mut Normals) -> Vec<f32> {
    clean.iter().map(|value| (f64::from(*value) + sd * draws.draw()) as f32).collect()
}

#[test]
fn the_noise_level_is_right_to_one_255th_from_0_to_30() {
    let pictures = pictures(3);
    let mut errors = [vec![], vec![]];
    for level in [0.0, 2.0, 10.0, 30.0] {
        for (index, picture) in pictures.iter().enumerate() {
            let mut draws = Normals::new(7, index as u64);
            let planes = picture.each_ref().map(|plane| noisy(plane, level / 255.0, &mut draws));
            errors[0].push(255.0 * noise_level(&planes[1], SIZE[0], SIZE[1]).unwrap() - level);
            errors[1]
                .push(255.0 * noise_level_rgb(planes.each_ref().map(Vec::as_slice), SIZE[0], SIZE[1]).unwrap() - level);
        }
        let here = |errors: &[f64]| errors[errors.len() - pictures.len()..].iter().sum::<f64>() / pictures.len() as f64;
        println!("level {level}: bias {:+.3} one plane, {:+.3} three", here(&errors[0]), here(&errors[1]));
    }
    for (planes, errors) in [1, 3].iter().zip(&errors) {
        let bias = errors.iter().sum::<f64>() / errors.len() as f64;
        let worst = errors.iter().fold(0.0, |worst: f64, error| worst.max(error.abs()));
        println!("{planes} planes: {} draws, bias {bias:+.3}, worst {worst:.3} (1/255)", errors.len());
        assert!(worst < 1.0 && bias.abs() < 0.3, "{planes} planes: bias {bias}, worst {worst}");
    }
}
