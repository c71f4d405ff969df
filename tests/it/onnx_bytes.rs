//! Small ONNX graphs written byte by byte (they are protobuf messages), so that no exporter is needed to test and time what runs them.

/// A field of protobuf: its number and a number.
pub fn number(field: u8, value: u64) -> Vec<u8> {
    let mut bytes = vec![];
    // The wire's kind in the last three bits: 0 a number, 2 a length and what has it.
    varint(u64::from(field) << 3, &mut bytes);
    varint(value, &mut bytes);
    bytes
}

/// A field of protobuf: its number and a message or text.
pub fn inner(field: u8, content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![];
    varint(u64::from(field) << 3 | 2, &mut bytes);
    varint(content.len() as u64, &mut bytes);
    bytes.extend(content);
    bytes
}

fn varint(mut value: u64, into: &mut Vec<u8>) {
    while value >= 128 {
        into.push(value as u8 | 128);
        value >>= 7;
    }
    into.push(value as u8);
}

/// AttributeProto of whole numbers.
pub fn attribute(name: &str, values: &[u64]) -> Vec<u8> {
    let ints: Vec<u8> = values.iter().flat_map(|value| number(8, *value)).collect();
    inner(5, &[inner(1, name.as_bytes()), ints, number(20, 7)].concat())
}

/// NodeProto inside a graph.
pub fn node(operator: &str, inputs: &[&str], output: &str, attributes: &[Vec<u8>]) -> Vec<u8> {
    let inputs: Vec<u8> = inputs.iter().flat_map(|name| inner(1, name.as_bytes())).collect();
    inner(1, &[inputs, inner(2, output.as_bytes()), inner(4, operator.as_bytes()), attributes.concat()].concat())
}

/// ValueInfoProto of floats with four sides of any length.
pub fn value(field: u8, name: &str) -> Vec<u8> {
    let side = |name: &str| inner(1, &inner(2, name.as_bytes()));
    let shape: Vec<u8> = ["n", "c", "h", "w"].iter().flat_map(|side_of| side(&format!("{name}_{side_of}"))).collect();
    let tensor = inner(1, &[number(1, 1), inner(2, &shape)].concat());
    inner(field, &[inner(1, name.as_bytes()), inner(2, &tensor)].concat())
}

/// ModelProto of an operator set; in the ninth a slice has its ends as attributes.
pub fn model(operators: u64, parts: &[Vec<u8>]) -> Vec<u8> {
    let graph = [parts.concat(), inner(2, b"graph")].concat();
    [number(1, 4), inner(7, &graph), inner(8, &number(2, operators))].concat()
}

/// Flow that is the difference of the red and of the green of two images, pooled where a cell's side is given.
pub fn difference(cell: Option<u64>) -> Vec<u8> {
    let ends = [attribute("axes", &[1]), attribute("ends", &[2]), attribute("starts", &[0])];
    let mut parts = vec![node("Sub", &["older", "newer"], "all", &[])];
    match cell {
        None => parts.push(node("Slice", &["all"], "flow", &ends)),
        Some(side) => {
            parts.push(node("Slice", &["all"], "two", &ends));
            let pooling = [attribute("kernel_shape", &[side, side]), attribute("strides", &[side, side])];
            parts.push(node("AveragePool", &["two"], "flow", &pooling));
        }
    }
    parts.extend([value(11, "older"), value(11, "newer"), value(12, "flow")]);
    model(9, &parts)
}

/// One image, half as bright: the mean of it and of its difference to itself.
pub fn halved() -> Vec<u8> {
    let parts = [
        node("Sub", &["image", "image"], "nothing", &[]),
        node("Mean", &["image", "nothing"], "half", &[]),
        value(11, "image"),
        value(12, "half"),
    ];
    model(9, &parts)
}
