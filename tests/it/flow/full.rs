//! A vector for every pixel: the network's upsampler follows the edges that the frame shows, and is said to run.

use nightflow::flow::{Matcher, Own, Resolution, padding};

use super::{frame, full, named, pair, quarter};
use nightflow::exposure::Exposed;

/// Pixels of an edge at `EDGE` along x: what is left of it is brighter and goes to the right, what is right of it stands.
const EDGE: usize = 97;
const MOVED: usize = 6;

/// A dark ground that stands still, and over its left part a bright one that ends at `edge`.
fn divided(size: [usize; 2], edge: usize, number: u64) -> Exposed {
    let [width, height] = size;
    let ground = frame(width, height, (0.0, 0.0), number);
    let over = frame(width, height, (40.0 - edge as f64, 25.0), number);
    let rgb = ground.rgb.iter().zip(&over.rgb).enumerate().map(|(i, (under, over))| match i % width < edge {
        true => 0.35 + 0.6 * over,
        false => 0.4 * under,
    });
    Exposed { rgb: rgb.collect(), ..ground }
}

/// Mean error in pixels over the columns this near to the edge.
fn off(vectors: &[f32], [width, height]: [usize; 2]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for y in 16..height - 16 {
        for x in EDGE - 8..EDGE + 8 {
            let truth = if x < EDGE { MOVED as f32 } else { 0.0 };
            let [u, v] = [0, 1].map(|axis| vectors[2 * (y * width + x) + axis] / 4.0);
            sum += f64::from((u - truth).hypot(v));
            count += 1.0;
        }
    }
    sum / count
}

#[test]
fn every_pixel_takes_the_side_of_the_edge_that_it_is_on() {
    // The second is no multiple of the network's stride.
    for size in [[192, 128], [180, 100]] {
        let (older, newer) = (divided(size, EDGE, 1), divided(size, EDGE + MOVED, 2));
        let pair = pair(&older, &newer);
        let (mut own, mut cells) = (Own::default(), Own::default());
        let mut matcher = Matcher::open(&full()).unwrap();
        let flow = matcher.between(&pair, &mut own).unwrap();
        assert_eq!([flow.grid.width, flow.grid.height], size);
        let seen = off(flow.vectors, size);
        let mut network = named(&quarter().network);
        let coarse = network.between(&pair, &mut cells).unwrap();
        let mut between = vec![0.0; 2 * size[0] * size[1]];
        padding::enlarge(coarse.vectors, (coarse.grid.width, coarse.grid.height), &mut between, size[0], 2);
        let bilinear = off(&between, size);
        println!("{size:?}: {seen:.3} px beside the edge, {bilinear:.3} between the cells");
        assert!(seen < 0.8 * bilinear, "{size:?}: {seen:.3} px beside the edge, {bilinear:.3} between the cells");
        assert!(flow.confidence.iter().all(|confidence| (0.0..=1.0).contains(confidence)));
    }
}

#[test]
fn a_recording_knows_that_it_ran() {
    let files = |resolution| {
        let matcher = Matcher::open(&nightflow::flow::Config { resolution, ..quarter() }).unwrap();
        matcher.model().sha256.iter().map(|(file, _)| file.clone()).collect::<Vec<_>>()
    };
    let (coarse, fine) = (files(Resolution::Quarter), files(Resolution::Full));
    assert_eq!(coarse, fine[..2]);
    assert_eq!(fine[2..], ["upsampler_fcdn.onnx"]);
    // Without one the flow is interpolated.
    let config = nightflow::flow::Config { network: "raftsmall_fcdn_4".into(), ..full() };
    assert_eq!(Matcher::open(&config).unwrap().model().sha256.len(), 2);
}
