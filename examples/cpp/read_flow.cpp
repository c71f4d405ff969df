// Reads the flow of a running node out of shared memory with iceoryx2's C++ binding, without a copy.
// See README.md beside this file for the build.

#include "iox2/iceoryx2.hpp"

#include <cstdint>
#include <iostream>
#include <string>

// Field by field as nightflow::publish::shared::FlowHeader; stamps are nanoseconds since the epoch.
struct FlowHeader {
    static constexpr const char* IOX2_TYPE_NAME = "nightflow::FlowHeader";

    std::int64_t older_ns;
    std::int64_t newer_ns;
    std::int64_t published_ns;
    std::uint64_t step;
    std::uint64_t displaced;
    std::uint64_t lost;
    std::uint32_t width;
    std::uint32_t height;
    std::uint32_t camera_width;
    std::uint32_t camera_height;
    float scale_x;
    float scale_y;
    std::uint32_t state; // 0 ok, 1 degraded, 2 blind
    std::uint32_t cause; // 0 none, 1 dark, 2 saturated, 3 gain step, 4 unsure, 5 frozen, 6 noisy
    float gain;
    float raw_mean;
    float saturated;
    float confidence;
};
static_assert(sizeof(FlowHeader) == 96);

// Field by field as nightflow::publish::shared::VelocitySample; without a velocity valid is 0 and numbers are NaN.
struct VelocitySample {
    static constexpr const char* IOX2_TYPE_NAME = "nightflow::VelocitySample";

    std::int64_t older_ns;
    std::int64_t newer_ns;
    std::int64_t published_ns;
    std::uint64_t step;
    double linear[3];  // body frame, FLU: m/s, or 1/s when scale is 1
    double angular[3]; // rad/s
    double covariance[36];
    double distance;
    std::uint32_t valid;
    std::uint32_t scale;
    std::uint32_t state;
    std::uint32_t cause;
    std::uint32_t lack;
    std::uint32_t samples;
    std::uint32_t inliers;
    std::uint32_t quality;
};
static_assert(sizeof(VelocitySample) == 408);

// Field by field as nightflow::publish::shared::ObstaclesSample; where nothing is known valid is 0.
struct ObstaclesSample {
    static constexpr const char* IOX2_TYPE_NAME = "nightflow::ObstaclesSample";

    std::int64_t older_ns;
    std::int64_t newer_ns;
    std::int64_t published_ns;
    std::uint64_t step;
    double heading[3]; // level body frame, unit length
    double heading_sd;
    double speed; // m/s, NaN when not metric
    double horizon_s;
    double delay_s;
    std::uint32_t valid;
    std::uint32_t state;
    std::uint32_t cause;
    std::uint32_t sight; // 0 seen, below 64 as lack, 64 not asked for, 65 bare, 66 no parallax
    float ttc_s[72];     // sector k looks along -pi + k 2 pi / 72, counter-clockwise; 36 looks forward
    float distance_m[72];
    float confidence[72];
    std::uint8_t sector[72]; // 0 unknown, 1 free, 2 occupied
};
static_assert(sizeof(ObstaclesSample) == 1040);

auto main(int argc, char** argv) -> int {
    using namespace iox2;
    set_log_level_from_env_or(LogLevel::Error);
    const std::string prefix = argc > 1 ? argv[1] : "nightflow";

    auto node = NodeBuilder().create<ServiceType::Ipc>().value();
    auto flow = node.service_builder(ServiceName::create((prefix + "/flow").c_str()).value())
                    .publish_subscribe<bb::Slice<float>>()
                    .user_header<FlowHeader>()
                    .open()
                    .value()
                    .subscriber_builder()
                    .create()
                    .value();
    auto velocity = node.service_builder(ServiceName::create((prefix + "/velocity").c_str()).value())
                        .publish_subscribe<VelocitySample>()
                        .open()
                        .value()
                        .subscriber_builder()
                        .create()
                        .value();

    auto obstacles = node.service_builder(ServiceName::create((prefix + "/obstacles").c_str()).value())
                         .publish_subscribe<ObstaclesSample>()
                         .open()
                         .value()
                         .subscriber_builder()
                         .create()
                         .value();

    // Looks every millisecond; to be woken instead, listen on the event service of the same name as the flow.
    while (node.wait(bb::Duration::from_millis(1)).has_value()) {
        for (auto sample = flow.receive().value(); sample.has_value(); sample = flow.receive().value()) {
            const FlowHeader& header = sample->user_header();
            // (u right, v down) in camera pixels; the cell at (row, column) begins at 2 * (row * width + column).
            const auto payload = sample->payload();
            const auto middle = 2 * (header.height / 2 * header.width + header.width / 2);
            std::cout << "step " << header.step << ": " << header.width << "x" << header.height << ", "
                      << payload[middle] << " " << payload[middle + 1] << " px in the middle" << std::endl;
        }
        for (auto sample = velocity.receive().value(); sample.has_value(); sample = velocity.receive().value()) {
            const VelocitySample& found = sample->payload();
            if (found.valid == 1) {
                std::cout << "step " << found.step << ": velocity " << found.linear[0] << " " << found.linear[1] << " "
                          << found.linear[2] << std::endl;
            } else {
                // Not standing still: nothing is known.
                std::cout << "step " << found.step << ": no velocity" << std::endl;
            }
        }
        for (auto sample = obstacles.receive().value(); sample.has_value(); sample = obstacles.receive().value()) {
            const ObstaclesSample& found = sample->payload();
            // Unknown is not free: a planner keeps out of both unknown and occupied sectors.
            int nearest = -1;
            for (int k = 0; k < 72; k++) {
                if (found.sector[k] == 2 && (nearest < 0 || found.ttc_s[k] < found.ttc_s[nearest])) {
                    nearest = k;
                }
            }
            if (nearest >= 0) {
                std::cout << "step " << found.step << ": sector " << nearest << " in " << found.ttc_s[nearest] << " s"
                          << std::endl;
            }
        }
    }
    return 0;
}
