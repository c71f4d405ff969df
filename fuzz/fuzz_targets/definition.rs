//! Any text as a `.msg` definition and as a schema: `cargo +nightly fuzz run definition`.
#![no_main]

use libfuzzer_sys::fuzz_target;
use nightflow::wire::Definitions;

const NAME: &str = "some_msgs/msg/Thing";

fuzz_target!(|text: &str| {
    let mut all = Definitions::default();
    if all.insert_schema(NAME, text).is_err() {
        return;
    }
    let (Ok(schema), Ok(hash)) = (all.schema(NAME), all.type_hash(NAME)) else { return };
    let mut again = Definitions::default();
    again.insert_schema(NAME, &schema).unwrap_or_else(|error| panic!("our own schema: {error}"));
    assert_eq!(again.type_hash(NAME), Ok(hash));
});
