// A frame's forward pass and its backward pass to the screen: memory, kernels and host launches.
#include "cuda/bin.cuh"
#include "cuda/blend.cuh"
#include "cuda/blend_back.cuh"
#include "cuda/frame.h"
#include "cuda/grid.cuh"
#include "cuda/project.cuh"
#include "cuda/sort.cuh"
#include "cuda/stream.h"
#include "raster/view.h"

namespace splat {
namespace cuda {
namespace {

constexpr int64_t kMaxPairs = (int64_t{1} << 31) - kSortBlock;  // per chunk: they are counted in signed 32 bits
constexpr int kDepthPasses = 32 / kDigitBits;
static_assert(kDepthPasses % 2 == 0, "what is sorted ends where it began");
constexpr int kProjectBlocks = 3;  // per multiprocessor: worth the three words spilled for it
constexpr int kScatterBlocks = 3;  // with more, registers are spilled
constexpr int kRestBlocks = 2;     // with more, more registers are spilled
constexpr int64_t kTurns = 8;      // blocks a multiprocessor of work that is done in turns: what it holds at once

// A pass of the sort by depth, from one half of the memory to the other or back; the first takes places for values.
using DepthPass = SortPass<uint32_t, int32_t>;

DepthPass depth_pass(const Job& job, int pass) {
    const FrameMemory& at = job.at;
    const int from = pass % 2, to = 1 - from;
    int32_t* visible = &at.header->visible;
    return {at.keys[from],
            at.keys[to],
            pass ? at.order[from] : nullptr,
            at.order[to],
            job.model.count,
            pass ? visible : nullptr,
            pass * kDigitBits,
            at.digit_table,
            at.digit_sums,
            pass ? nullptr : visible};
}

__global__ void __launch_bounds__(kThreads, kProjectBlocks) project_kernel(Job job) { project_phase(job); }

__global__ void __launch_bounds__(kThreads) count_depths(DepthPass pass) { count_digits(pass); }
__global__ void __launch_bounds__(kThreads) scan_depths(DepthPass pass) { scan_digits(pass); }
__global__ void __launch_bounds__(kThreads, kScatterBlocks) scatter_depths(DepthPass pass) { scatter_digits(pass); }

__global__ void __launch_bounds__(kThreads) plan_kernel(Job job) { plan_phase(job); }

__device__ inline bool is_to_bin(const Job& job, const Turn& turn) {
    return is_chunk(job, turn.chunk) && !(turn.back && job.at.header->facts.chunks == 1);
}

__global__ void __launch_bounds__(kThreads) count_pairs_kernel(Job job, Turn turn) {
    if (is_to_bin(job, turn)) count_pairs(job, turn.chunk);
}
__global__ void __launch_bounds__(kThreads) scan_pairs_kernel(Job job, Turn turn) {
    if (is_to_bin(job, turn)) scan_pairs(job);
}
__global__ void __launch_bounds__(kThreads) emit_pairs_kernel(Job job, Turn turn) {
    if (is_to_bin(job, turn)) emit_pairs(job, turn.chunk);
}
__global__ void __launch_bounds__(kThreads) count_tiles(Job job, Turn turn, TilePass pass) {
    if (is_to_bin(job, turn)) count_digits(pass);
}
__global__ void __launch_bounds__(kThreads) scan_tiles(Job job, Turn turn, TilePass pass) {
    if (is_to_bin(job, turn)) scan_digits(pass);
}
__global__ void __launch_bounds__(kThreads, kScatterBlocks) scatter_tiles(Job job, Turn turn, TilePass pass) {
    if (is_to_bin(job, turn)) scatter_digits(pass);
}

template <bool kDepth>
__global__ void __launch_bounds__(kThreads, kBlendBlocks) blend_kernel(Job job, int chunk) {
    if (is_chunk(job, chunk)) blend_tiles<kDepth>(job, chunk);
}

// `only`: leave the chunk to rest_back unless it is the only one.
template <bool kDepth, bool kMagnitudes>
__global__ void __launch_bounds__(kThreads, kBlendBlocks) blend_back_kernel(Job job, int chunk, bool only) {
    if (is_chunk(job, chunk) && !(only && job.at.header->facts.chunks > 1))
        blend_tiles_back<kDepth, kMagnitudes>(job, chunk);
}

template <bool kDepth>
__global__ void __launch_bounds__(kThreads) sum_kernel(Job job, int chunk, bool only) {
    if (is_chunk(job, chunk) && !(only && job.at.header->facts.chunks > 1)) sum_slots<kDepth>(job, chunk);
}

// What exceeds the forecast, however many chunks: the host knows of none, and a launch for each that there might be
// would cost more than the frame. Without any, the blocks return at once.
template <bool kDepth>
__global__ void __launch_bounds__(kThreads, kRestBlocks) rest_kernel(const __grid_constant__ Job job, int first) {
    for (int chunk = first; is_chunk(job, chunk); ++chunk) {
        bin_chunk(job, chunk);
        blend_tiles<kDepth>(job, chunk);
        sync_grid();
    }
}

template <bool kDepth, bool kMagnitudes>
__global__ void __launch_bounds__(kThreads, kRestBlocks) rest_back_kernel(const __grid_constant__ Job job, int first) {
    if (job.at.header->facts.chunks == 1) return;
    for (int chunk = first; is_chunk(job, chunk); ++chunk) {
        bin_chunk(job, chunk);
        blend_tiles_back<kDepth, kMagnitudes>(job, chunk);
        sync_grid();
        sum_slots<kDepth>(job, chunk);
        sync_grid();
    }
}

bool is_size(const SplatShot* shot, int64_t count, int64_t capacity, View* view) {
    return shot && !find_view(*shot, view) && count >= 0 && capacity >= count && capacity <= kMaxPairs;
}

int slot_floats_of(const SplatShot& shot) { return shot.depths ? kDepthSlotFloats : kSlotFloats; }

bool is_aligned(const void* memory) { return memory && reinterpret_cast<uintptr_t>(memory) % 256 == 0; }

template <bool kDepth>
void launch_chunks(const Job& job, int passes, cudaStream_t stream) {
    for (int chunk = 0; chunk < passes; ++chunk) {
        launch_bin(job, {chunk, false}, stream);
        SPLAT_LAUNCH(blend_kernel<kDepth>, tile_blocks(job), stream, job, chunk);
    }
    SPLAT_LAUNCH_TOGETHER(rest_kernel<kDepth>, blocks_together(rest_kernel<kDepth>), stream, job, passes);
}

// If one chunk is forecast, nothing bins it again: any further chunks belong to the rest.
template <bool kDepth, bool kMagnitudes>
void launch_chunks_back(const Job& job, int passes, cudaStream_t stream) {
    const bool only = passes == 1;
    const int64_t ranks = blocks_for(divide_up(job.model.count, kSlotsAtOnce));
    for (int chunk = 0; chunk < passes; ++chunk) {
        if (!only) launch_bin(job, {chunk, true}, stream);
        SPLAT_LAUNCH((blend_back_kernel<kDepth, kMagnitudes>), tile_blocks(job), stream, job, chunk, only);
        SPLAT_LAUNCH(sum_kernel<kDepth>, ranks, stream, job, chunk, only);
    }
    const auto rest = rest_back_kernel<kDepth, kMagnitudes>;
    SPLAT_LAUNCH_TOGETHER(rest, blocks_together(rest), stream, job, only ? 0 : passes);
}

bool has_pictures(const SplatShot& shot, const SplatPictures& to) {
    const bool all = to.depth_sum && to.depth_square_sum && to.median_depth;
    const bool none = !to.depth_sum && !to.depth_square_sum && !to.median_depth;
    return to.colour && to.alpha && (shot.depths ? all : none);
}

}  // namespace

int passes_of(const Job& job, const SplatFrame& frame) {
    const int least = static_cast<int>(divide_up(job.tiles, kChunkTiles));
    return frame.passes > least ? frame.passes : least;
}

void clear_counts(const Job& job, cudaStream_t stream) {
    cudaMemsetAsync(job.at.header, 0, sizeof(Header), stream);
    cudaMemsetAsync(job.at.tile_counts, 0, (job.tiles + size_t{1}) * sizeof(int32_t), stream);
}

void launch_plan(const Job& job, cudaStream_t stream) {
    if (job.model.count) {
        const int64_t blocks = blocks_for(sort_blocks(job.model.count));
        for (int pass = 0; pass < kDepthPasses; ++pass) {
            const DepthPass of = depth_pass(job, pass);
            SPLAT_LAUNCH(count_depths, blocks, stream, of);
            SPLAT_LAUNCH(scan_depths, kScanBlocks, stream, of);
            SPLAT_LAUNCH(scatter_depths, blocks, stream, of);
        }
    }
    SPLAT_LAUNCH(plan_kernel, 1, stream, job);
}

void launch_bin(const Job& job, const Turn& turn, cudaStream_t stream) {
    const int64_t ranks = blocks_for(divide_up(job.model.count, kScanBlock));
    const int64_t blocks = blocks_for(sort_blocks(job.capacity));
    SPLAT_LAUNCH(count_pairs_kernel, ranks, stream, job, turn);
    SPLAT_LAUNCH(scan_pairs_kernel, 1, stream, job, turn);
    SPLAT_LAUNCH(emit_pairs_kernel, ranks, stream, job, turn);
    for (int pass = 0; pass < kTilePasses; ++pass) {
        const TilePass of = tile_pass(job.at, pass);
        SPLAT_LAUNCH(count_tiles, blocks, stream, job, turn, of);
        SPLAT_LAUNCH(scan_tiles, kScanBlocks, stream, job, turn, of);
        SPLAT_LAUNCH(scatter_tiles, blocks, stream, job, turn, of);
    }
}

int64_t tile_blocks(const Job& job) { return job.tiles < kChunkTiles ? job.tiles : kChunkTiles; }

int64_t lay_out(void* memory, int64_t count, int64_t tiles, int64_t capacity, FrameMemory* at) {
    Carver carver(memory);
    const int64_t blocks = sort_blocks(count > capacity ? count : capacity);
    at->header = carver.take<Header>(1);
    at->records = carver.take<Record>(count);
    at->rows = carver.take<uint32_t>(count);
    at->order[0] = carver.take<int32_t>(count);
    at->offsets = carver.take<uint32_t>(count);
    at->block_sums = carver.take<uint32_t>(divide_up(count, kScanBlock) + 1);
    at->digit_table = carver.take<uint32_t>(kDigits * blocks);
    at->digit_sums = carver.take<uint32_t>(kDigits);
    at->tile_counts = carver.take<int32_t>(tiles + 1);
    at->tile_begin = carver.take<int64_t>(tiles + 1);
    at->chunk_begin = carver.take<int32_t>(tiles + 1);
    at->transmittance = carver.take<float>(tiles * kTilePixels);
    at->pixel_end = carver.take<int32_t>(tiles * kTilePixels);
    for (int i = 0; i < 2; ++i) at->pair_keys[i] = carver.take<uint16_t>(capacity);
    for (int i = 0; i < 2; ++i) at->pair_values[i] = carver.take<uint32_t>(capacity);
    at->owners = carver.take<uint32_t>(capacity);
    // Depth keys are not needed after their sort, and before it there are no pairs. `capacity` is at least `count`.
    at->keys[0] = at->pair_values[0], at->keys[1] = at->pair_values[1];
    at->order[1] = reinterpret_cast<int32_t*>(at->owners);
    return carver.bytes();
}

int64_t lay_out(void* memory, int64_t count, int64_t capacity, int slot_floats, BackMemory* at) {
    Carver carver(memory);
    at->slots = carver.take<float>(capacity * slot_floats);
    at->sums = carver.take<float>(count * slot_floats);
    return carver.bytes();
}

int32_t prepare(const SplatShot* shot, const SplatFrame* frame, Job* job) {
    *job = Job{};
    if (!frame || !is_size(shot, frame->count, frame->capacity, &job->view)) return SPLAT_BAD_ARGUMENT;
    if (frame->passes < 1 || !is_aligned(frame->memory)) return SPLAT_BAD_ARGUMENT;
    job->model.count = frame->count;
    job->capacity = frame->capacity;
    job->tiles = job->view.tiles_x * job->view.tiles_y;
    const int64_t bytes = lay_out(frame->memory, frame->count, job->tiles, frame->capacity, &job->at);
    return bytes > frame->bytes ? SPLAT_TOO_LITTLE : SPLAT_OK;
}

int32_t prepare(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame, bool back, Job* job) {
    const bool has_rows =
        model && model->means && model->log_scales && model->quats && model->opacity_logits && model->sh;
    if (!model || !frame || (frame->count && !has_rows)) return SPLAT_BAD_ARGUMENT;
    if (const int32_t code = prepare(shot, frame, job)) return code;
    job->model = {frame->count, model->means, model->log_scales, model->quats, model->opacity_logits, model->sh};
    job->slot_floats = slot_floats_of(*shot);
    job->magnitudes = shot->magnitudes;
    if (!back) return SPLAT_OK;
    const int64_t bytes = lay_out(frame->back, frame->count, frame->capacity, job->slot_floats, &job->back);
    if (bytes > frame->back_bytes) return SPLAT_TOO_LITTLE;
    return bytes == 0 || is_aligned(frame->back) ? SPLAT_OK : SPLAT_BAD_ARGUMENT;
}

int64_t blocks_for(int64_t work) {
    int device = 0, multiprocessors = 1;
    cudaGetDevice(&device);
    cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, device);
    const int64_t most = multiprocessors * kTurns, wanted = work < 1 ? 1 : work;
    return wanted < most ? wanted : most;
}

}  // namespace cuda
}  // namespace splat

using namespace splat::cuda;

int64_t splat_frame_bytes(const SplatShot* shot, int64_t count, int64_t capacity) {
    splat::View view;
    FrameMemory at;
    if (!is_size(shot, count, capacity, &view)) return SPLAT_BAD_ARGUMENT;
    return lay_out(nullptr, count, int64_t{view.tiles_x} * view.tiles_y, capacity, &at);
}

int64_t splat_back_bytes(const SplatShot* shot, int64_t count, int64_t capacity) {
    splat::View view;
    BackMemory at;
    if (!is_size(shot, count, capacity, &view)) return SPLAT_BAD_ARGUMENT;
    return lay_out(nullptr, count, capacity, slot_floats_of(*shot), &at);
}

int32_t splat_forward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                      const SplatPictures* pictures, float* radii, uint8_t* visible, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    Job job;
    const int32_t code = prepare(shot, model, frame, false, &job);
    if (code) return code;
    if (!pictures || !has_pictures(*shot, *pictures) || (frame->count && !(radii && visible)))
        return SPLAT_BAD_ARGUMENT;
    job.pictures = {pictures->colour, pictures->alpha, pictures->depth_sum, pictures->depth_square_sum,
                    pictures->median_depth};
    job.radii = radii, job.visible = visible;
    clear_counts(job, stream);
    if (frame->count) SPLAT_LAUNCH(project_kernel, divide_up(frame->count, kThreads), stream, job);
    launch_plan(job, stream);
    const int passes = passes_of(job, *frame);
    if (shot->depths)
        launch_chunks<true>(job, passes, stream);
    else
        launch_chunks<false>(job, passes, stream);
    return cudaGetLastError();
}

int32_t splat_blend_backward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                             const SplatPictureGradients* gradients, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    Job job;
    const int32_t code = prepare(shot, model, frame, true, &job);
    if (code) return code;
    if (!gradients || (!shot->depths && (gradients->depth_sum || gradients->depth_square_sum)))
        return SPLAT_BAD_ARGUMENT;
    job.gradients = {gradients->colour, gradients->alpha, gradients->depth_sum, gradients->depth_square_sum};
    if (frame->count == 0) return SPLAT_OK;
    const auto bytes = static_cast<size_t>(frame->count) * job.slot_floats * sizeof(float);
    cudaMemsetAsync(job.back.sums, 0, bytes, stream);
    const int passes = passes_of(job, *frame);
    if (shot->depths && shot->magnitudes)
        launch_chunks_back<true, true>(job, passes, stream);
    else if (shot->depths)
        launch_chunks_back<true, false>(job, passes, stream);
    else if (shot->magnitudes)
        launch_chunks_back<false, true>(job, passes, stream);
    else
        launch_chunks_back<false, false>(job, passes, stream);
    return cudaGetLastError();
}
