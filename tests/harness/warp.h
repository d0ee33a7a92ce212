// A warp's lanes, what they wait for, and the results of its operations.
#pragma once

#include "cuda_on_cpu.h"

namespace harness {
namespace {

constexpr int kLanes = warpSize;
constexpr uint32_t kPoison = 0x7fa5a5a5u;  // a float: signalling NaN; an index: out of any range

struct Warp {
    uint32_t ready, waiting, at_barrier, ended;
    bool alike;     // all that wait ask for the same
    Request asked;  // by those that wait; where not alike, each lane's:
    Request requests[kLanes];
    uint64_t values[kLanes], results[kLanes];
    int arguments[kLanes];
};

bool operator==(const Request& a, const Request& b) {
    return a.operation == b.operation && a.mask == b.mask && a.width == b.width && a.place.line == b.place.line;
}

// The lane that another one's value comes from.
int source(const Request& request, int lane, int argument) {
    const int segment = lane & ~(request.width - 1), last = segment + request.width - 1;
    switch (request.operation) {
        case Operation::shuffle:
            return segment + (argument & (request.width - 1));
        case Operation::shuffle_up:
            return lane - argument < segment ? lane : lane - argument;
        case Operation::shuffle_down:
            return lane + argument > last ? lane : lane + argument;
        default:
            return (lane ^ argument) > last ? lane : lane ^ argument;
    }
}

uint32_t lanes_with(const Warp& warp, uint32_t mask, uint64_t value) {
    uint32_t with = 0;
    for (int lane = 0; lane < kLanes; ++lane) with |= static_cast<uint32_t>(warp.values[lane] == value) << lane;
    return with & mask;
}

// The result for each lane once all lanes of a mask have met. Lanes outside the mask may wait for something else.
void complete(Warp* warp, const Request& request) {
    const auto give = [&](auto&& result) {
        for (uint32_t left = request.mask; left; left &= left - 1) {
            const int lane = __builtin_ctz(left);
            warp->results[lane] = result(lane);
        }
    };
    const uint64_t nothing = uint64_t{kPoison} << 32 | kPoison;  // a lane that takes no part has no value
    uint64_t ballot = 0;
    switch (request.operation) {
        case Operation::syncwarp:
            return;
        case Operation::ballot:
        case Operation::any:
        case Operation::all:
            ballot = lanes_with(*warp, request.mask, 1);
            if (request.operation == Operation::any) ballot = ballot != 0;
            if (request.operation == Operation::all) ballot = ballot == request.mask;
            return give([&](int) { return ballot; });
        case Operation::match:
            return give([&](int lane) { return lanes_with(*warp, request.mask, warp->values[lane]); });
        default:
            return give([&](int lane) {
                const int from = source(request, lane, warp->arguments[lane]);
                return request.mask >> from & 1u ? warp->values[from] : nothing;
            });
    }
}

// The request of a lane in the mask that differs from the others; null if all agree.
const Request* differing(const Warp& warp, const Request& request) {
    if (warp.alike) return nullptr;
    for (uint32_t left = request.mask; left; left &= left - 1) {
        const Request& other = warp.requests[__builtin_ctz(left)];
        if (!(other == request)) return &other;
    }
    return nullptr;
}

// Stores a lane's request: once for all lanes as long as they agree.
void ask(Warp* warp, int lane, const Request& request) {
    if (warp->waiting == 0) {
        warp->asked = request, warp->alike = true;
    } else if (warp->alike && !(warp->asked == request)) {
        for (Request& each : warp->requests) each = warp->asked;
        warp->alike = false;
    }
    if (!warp->alike) warp->requests[lane] = request;
}

}  // namespace
}  // namespace harness
