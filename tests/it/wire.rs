//! The messages: their hashes, their CDR against their definitions, and what hostile bytes can do.

use nightflow::wire::{self, CameraInfo, Header, Image, Imu, TwistWithCovarianceStamped};

#[test]
fn hashes_are_those_that_ros_2_publishes() {
    // From the headers that ROS 2 Jazzy's generators wrote.
    let known = [
        (wire::type_hash::<Image>(), "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"),
        (wire::type_hash::<CameraInfo>(), "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275"),
        (wire::type_hash::<Header>(), "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01"),
        (wire::type_hash::<Imu>(), "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"),
        (
            wire::type_hash::<wire::CompressedImage>(),
            "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
        ),
        (
            wire::type_hash::<TwistWithCovarianceStamped>(),
            "77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563",
        ),
    ];
    for (ours, theirs) in known {
        assert_eq!(ours, format!("RIHS01_{theirs}"));
    }
}

#[test]
fn an_image_has_the_bytes_that_the_specification_gives_it() {
    let image = Image {
        header: Header { stamp: wire::Time { sec: 1, nanosec: 2 }, frame_id: "cam".to_owned() },
        height: 1,
        width: 2,
        encoding: "mono8".to_owned(),
        is_bigendian: 0,
        step: 2,
        data: vec![7, 8],
    };
    #[rustfmt::skip]
    let bytes = [
        0, 1, 0, 0,
        1, 0, 0, 0, 2, 0, 0, 0,
        4, 0, 0, 0, b'c', b'a', b'm', 0,
        1, 0, 0, 0, 2, 0, 0, 0,
        6, 0, 0, 0, b'm', b'o', b'n', b'o', b'8', 0,
        0, 0,
        2, 0, 0, 0,
        2, 0, 0, 0, 7, 8,
    ];
    let mut buffer = vec![9; 100];
    wire::encode(&image, &mut buffer).unwrap();
    assert_eq!(buffer, bytes);
    assert_eq!(wire::decode::<Image>(&bytes).unwrap(), image);
}
