//! Small recordings and frames for tests: a smooth, unrepeating pattern that moves by a known step.

use std::{path::Path, sync::Arc};

use nightflow::{
    camera::{Frame, Sample},
    clock::Stamp,
    recording::{self, Writer},
    wire::{Header, Image},
};

/// Camera columns and rows of the test frames.
pub const SIZE: [u32; 2] = [320, 256];
/// Nanoseconds between two frames.
pub const INTERVAL_NS: i64 = 33_333_333;
/// Stamp of the first frame.
pub const START_NS: i64 = 1_700_000_000_000_000_000;
/// The pattern moves by this much from frame to frame, in camera pixels right and down.
pub const STEP: [f64; 2] = [4.0, 2.0];

/// A 12-bit RGGB frame of a dark scene, number `index` of the sequence.
pub fn frame(index: i64) -> Frame {
    let [width, height] = SIZE;
    let mut data = Vec::with_capacity((width * height * 2) as usize);
    for y in 0..height {
        for x in 0..width {
            let (px, py) = (f64::from(x) - STEP[0] * index as f64, f64::from(y) - STEP[1] * index as f64);
            let pattern = (0.11 * px + 0.07 * py).sin()
                + (0.23 * px - 0.19 * py).cos() * 0.7
                + (0.031 * px * 1.7 + 0.05 * py).sin();
            let count = 256.0 + 140.0 * (1.0 + 0.3 * pattern);
            data.extend_from_slice(&(count as u16).to_le_bytes());
        }
    }
    let stamp = Stamp::from_ns(START_NS + index * INTERVAL_NS);
    let image = Image {
        header: Header { stamp: stamp.into(), frame_id: "camera_optical".into() },
        height,
        width,
        encoding: "bayer_rggb16".into(),
        is_bigendian: 0,
        step: width * 2,
        data,
    };
    Frame { image, received: stamp }
}

/// The same as a sample.
pub fn sample(index: i64) -> Sample {
    Sample::Frame(Arc::new(frame(index)))
}

/// The settings that fit the frames.
pub const SETTINGS: &str = "[exposure]\nbit_depth = 12\nblack_level = 256\n";

/// A recording of the frames that `indices` names, with its settings inside.
pub fn write(path: &Path, indices: impl IntoIterator<Item = i64>) {
    let mut writer = Writer::create(path, &recording::Config::default()).unwrap();
    let known = [("config".to_owned(), SETTINGS.to_owned())].into_iter().collect();
    writer.attach_metadata("nightflow", &known).unwrap();
    for index in indices {
        let frame = frame(index);
        writer.write("/camera/image_raw", frame.received, frame.stamp(), &frame.image).unwrap();
    }
    writer.finish().unwrap();
}
