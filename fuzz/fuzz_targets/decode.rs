//! Bytes from anywhere as each message: `cargo +nightly fuzz run decode`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use nightflow::wire::{
    self, CameraInfo, CompressedImage, DiagnosticArray, EgoMotion, Image, Imu, LaserScan, Message, Range, Status, Step,
    TwistStamped, TwistWithCovarianceStamped, Vector3Stamped,
};

/// What is taken must come back the same from its own encoding: as bytes, since NaN equals nothing.
fn check<M: Message>(bytes: &[u8]) {
    let Ok(message) = wire::decode::<M>(bytes) else { return };
    let (mut first, mut second) = (Vec::new(), Vec::new());
    // A text with a zero in it can be read, but has no encoding.
    if wire::encode(&message, &mut first).is_err() {
        return;
    }
    let again = wire::decode::<M>(&first).unwrap_or_else(|error| panic!("our own bytes: {error}"));
    wire::encode(&again, &mut second).unwrap_or_else(|error| panic!("our own message: {error}"));
    assert_eq!(first, second);
}

fuzz_target!(|input: &[u8]| {
    let Some((choice, bytes)) = input.split_first() else { return };
    let checks: [fn(&[u8]); 13] = [
        check::<Image>,
        check::<CompressedImage>,
        check::<CameraInfo>,
        check::<Imu>,
        check::<Range>,
        check::<LaserScan>,
        check::<Vector3Stamped>,
        check::<TwistStamped>,
        check::<TwistWithCovarianceStamped>,
        check::<DiagnosticArray>,
        check::<Step>,
        check::<EgoMotion>,
        check::<Status>,
    ];
    checks[usize::from(*choice) % checks.len()](bytes);
});
