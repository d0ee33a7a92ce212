// What a frame's memory holds, for the tests: its layout is the kernels' own matter.
#include "cuda/frame.h"

using namespace splat::cuda;

#define PEEK extern "C" __attribute__((visibility("default")))

// Where these lie: 0 the Gaussians by rank, 1 pairs of the view before each tile, 2 chunks' first tiles, 3 each pair's
// slot in a chunk's lists, 4 the Gaussian of a slot, 5 records, 6 tile rows.
PEEK void* peek(void* memory, int64_t count, int64_t tiles, int64_t capacity, int what) {
    FrameMemory at;
    lay_out(memory, count, tiles, capacity, &at);
    void* const places[] = {at.order[0], at.tile_begin, at.chunk_begin, at.pair_values[0],
                            at.owners,   at.records,    at.rows};
    return places[what];
}
