# What can be done here; `just` lists it.

# List the recipes.
default:
    @just --list

# The README's first command: a night recording becomes flow, pictures and a summary.
demo:
    cargo run --release -- replay recordings/night_flight.mcap --pictures target/pictures

# The README's second command: all tests.
test:
    cargo test

# The trainer's tests, in an environment of their own under target/trainer.
train-test:
    training/check.sh

# What CI runs.
ci:
    .ci/run

# Formatting and lints.
lint:
    cargo fmt --check
    cargo clippy --all-targets -- -D warnings

# Licences, advisories, duplicates, sources (needs cargo-deny).
deny:
    cargo deny check

# All benches, and the table beside their rivals.
bench:
    cargo bench

# Ours and the rivals down the brightness ladder: see benches/rivals/README.md.
ladder pairs out raft='':
    cargo build --release
    benches/rivals/ladder.sh {{pairs}} {{out}} {{raft}}

# Review changed snapshots (needs cargo-insta).
snapshots:
    cargo insta review
