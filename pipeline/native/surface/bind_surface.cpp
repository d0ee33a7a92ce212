// Python bindings of the surface model's kernels: argument checks; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <array>
#include <climits>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <tuple>

#include "surface/surface_cell_votes.h"
#include "surface/surface_colours.h"
#include "surface/surface_mosaic.h"
#include "surface/surface_sight.h"
#include "surface/surface_votes.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T>
using Plane = nb::ndarray<T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
template <class T>
using Row = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <class T>
using Cells = nb::ndarray<T, nb::c_contig, nb::device::cpu>;  // of any number of dimensions
using PlaceArrays = std::tuple<Cells<const double>, Cells<const double>, Cells<const double>>;  // east, north, up
using Pixels = nb::ndarray<const std::uint8_t, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Tone = nb::ndarray<const std::uint8_t, nb::shape<256, 3>, nb::c_contig, nb::device::cpu>;
template <class T>
using Stack = nb::ndarray<T, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using ColourStack = nb::ndarray<const std::uint8_t, nb::shape<-1, -1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Camera = std::tuple<Pose, std::array<int, 2>, std::array<double, 4>>;  // width, height; fx, fy, cx, cy
using Lens = std::tuple<double, nb::ndarray<const double, nb::shape<-1, -1, 2>, nb::c_contig, nb::device::cpu>>;
using Picture = std::tuple<Pixels, Tone, Camera, std::optional<Lens>>;
using Lattice = std::array<double, 3>;  // east, north, cell
using Rectangle = std::array<int, 4>;

constexpr int kMostCells = 1 << splat::kCellBits;
constexpr int kFarthest = 1 << 30;  // rows and columns

void require(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

bool all_finite(const double* values, int count) {
    for (int k = 0; k < count; ++k)
        if (!std::isfinite(values[k])) return false;
    return true;
}

splat::SurfaceCamera camera_of(const Camera& given) {
    const auto& [pose, size, lens] = given;
    splat::SurfaceCamera camera{};
    require(size[0] >= 1 && size[1] >= 1 && size[0] <= INT_MAX / size[1], "a photo without pixels, or with too many");
    require(all_finite(pose.data(), 16) && all_finite(lens.data(), 4) && lens[0] > 0.0 && lens[1] > 0.0,
            "a camera that is none");
    camera.width = size[0], camera.height = size[1];
    camera.fx = lens[0], camera.fy = lens[1], camera.cx = lens[2], camera.cy = lens[3];
    for (int row = 0; row < 3; ++row) {
        for (int column = 0; column < 3; ++column) camera.turn[3 * row + column] = pose(row, column);
        camera.shift[row] = pose(row, 3);
    }
    for (int k = 0; k < 3; ++k)
        camera.centre[k] = -(camera.turn[k] * camera.shift[0] + camera.turn[3 + k] * camera.shift[1] +
                             camera.turn[6 + k] * camera.shift[2]);
    return camera;
}

splat::CellTile tile_of(const Lattice& lattice, const Rectangle& tile, const std::array<double, 2>& relief) {
    const auto [row, column, height, width] = tile;
    const auto [low, high] = relief;
    require(all_finite(lattice.data(), 3) && lattice[2] > 0.0, "a lattice without cells");
    require(height >= 1 && width >= 1 && height <= kMostCells / width, "a tile without cells, or with too many");
    require(std::abs(static_cast<double>(row)) <= kFarthest && std::abs(static_cast<double>(column)) <= kFarthest,
            "a tile too far away");
    const double most = std::ldexp(splat::kHeightStep, splat::kStepBits);
    require(std::isfinite(low) && std::isfinite(high) && low < high && high - low < most, "heights too far apart");
    return {lattice[0], lattice[1], lattice[2], row, column, height, width, low, high};
}

bool is_size(const splat::SurfaceCamera& camera, std::size_t height, std::size_t width) {
    return height == static_cast<std::size_t>(camera.height) && width == static_cast<std::size_t>(camera.width);
}

splat::Places places_of(const PlaceArrays& given) {
    const auto& [east, north, up] = given;
    require(east.size() == up.size() && north.size() == up.size(), "places of different numbers");
    return {static_cast<std::int64_t>(up.size()), east.data(), north.data(), up.data()};
}

void look(const Plane<const float>& depth, const Camera& camera, const PlaceArrays& points,
          const std::optional<Cells<const double>>& sines, double least, const Cells<std::uint8_t>& said) {
    const splat::DepthPicture picture{camera_of(camera), depth.data(), nullptr};
    const splat::Places places = places_of(points);
    require(is_size(picture.camera, depth.shape(0), depth.shape(1)), "depths that are not of the camera's size");
    const std::size_t size = std::get<2>(points).size();
    require(said.size() == size && (!sines || sines->size() == size), "sines or a result of another size");
    const nb::gil_scoped_release released;
    SPLAT_KERNELS(sight_kernels).look(picture, places, sines ? sines->data() : nullptr, least, said.data());
}

std::int64_t rate(const Camera& given, const PlaceArrays& points, double cell, const Cells<const std::uint8_t>& said,
                  const Cells<std::uint16_t>& cost, const Cells<std::uint8_t>& seen) {
    const splat::SurfaceCamera camera = camera_of(given);
    const splat::Places places = places_of(points);
    const std::size_t size = std::get<2>(points).size();
    require(cell > 0.0 && said.size() == size && cost.size() == size && seen.size() == size,
            "results of another size, or cells of none");
    const nb::gil_scoped_release released;
    return SPLAT_KERNELS(sight_kernels).rate(camera, places, cell, said.data(), cost.data(), seen.data());
}

void confirm(const Plane<const float>& inverse, const Camera& given, const PlaceArrays& points,
             const std::array<double, 4>& agreeing, const Plane<double>& sums, const Row<std::uint8_t>& votes) {
    const splat::SurfaceCamera camera = camera_of(given);
    const splat::Places places = places_of(points);
    const std::size_t size = std::get<2>(points).size();
    require(is_size(camera, inverse.shape(0), inverse.shape(1)), "depths that are not of the camera's size");
    require(sums.shape(0) == size && sums.shape(1) == 3 && votes.size() == size, "results of another size");
    require(all_finite(agreeing.data(), 4) && agreeing[3] > 0.0, "photos without a parallax");
    const nb::gil_scoped_release released;
    SPLAT_KERNELS(sight_kernels)
        .confirm(camera, inverse.data(), places, {agreeing[0], agreeing[1], agreeing[2], agreeing[3]}, sums.data(),
                 votes.data());
}

splat::Photo photo_of(const Picture& given) {
    const auto& [pixels, tone, camera, lens] = given;
    splat::Photo photo{};
    photo.camera = camera_of(camera), photo.width = photo.camera.width, photo.height = photo.camera.height;
    photo.pixels = pixels.data(), photo.tone = tone.data();
    require(lens || is_size(photo.camera, pixels.shape(0), pixels.shape(1)),
            "pixels that are not of the camera's size");
    if (!lens) return photo;
    const auto& [step, nodes] = *lens;
    const std::size_t height = pixels.shape(0), width = pixels.shape(1), rows = nodes.shape(0),
                      columns = nodes.shape(1);
    require(height >= 1 && width >= 1 && height <= INT_MAX / width, "a photo without pixels, or with too many");
    require(step > 0.0 && rows >= 2 && columns >= 2 && rows <= INT_MAX / columns, "a lens that is none");
    photo.width = static_cast<int>(width), photo.height = static_cast<int>(height);
    photo.lens = {step, static_cast<int>(rows), static_cast<int>(columns), nodes.data()};
    return photo;
}

void sample_photo(const Picture& given, const PlaceArrays& points, double cell, const Cells<const std::uint8_t>& seen,
                  const Cells<std::uint8_t>& colour) {
    const splat::Photo photo = photo_of(given);
    const splat::Places places = places_of(points);
    const std::size_t size = std::get<2>(points).size();
    require(cell > 0.0 && seen.size() == size && colour.size() == 3 * size,
            "results of another size, or cells of none");
    const nb::gil_scoped_release released;
    splat::sample_photo(photo, places, cell, seen.data(), colour.data());
}

std::int64_t cells_of(const Stack<std::uint16_t>& cost) {
    const std::size_t height = cost.shape(1), width = cost.shape(2);
    require(cost.shape(0) <= INT16_MAX && height >= 1 && width >= 1 && height <= kMostCells / width,
            "too many photos or cells, or no cells");
    return static_cast<std::int64_t>(height * width);
}

void keep_best(const Stack<std::uint8_t>& seen, const Stack<std::uint16_t>& cost, int most,
               const Plane<std::uint8_t>& seen_by) {
    const std::int64_t cells = cells_of(cost);
    for (std::size_t side = 0; side < 3; ++side)
        require(cost.shape(side) == seen.shape(side), "photos of different sizes");
    require(seen_by.shape(0) == cost.shape(1) && seen_by.shape(1) == cost.shape(2), "a result of another size");
    require(most >= 1 && most <= splat::kMostKept, "too many photos of a cell, or none");
    const nb::gil_scoped_release released;
    splat::keep_best(static_cast<int>(cost.shape(0)), cells, most, cost.data(), seen.data(), seen_by.data());
}

void compose_mosaic(const Stack<const std::uint8_t>& seen, const Stack<std::uint16_t>& cost, const ColourStack& colour,
                    int parity, const Plane<std::int16_t>& label, const Cells<std::uint8_t>& blended) {
    const std::size_t photos = cost.shape(0), height = cost.shape(1), width = cost.shape(2);
    cells_of(cost);
    for (std::size_t side = 0; side < 3; ++side)
        require(cost.shape(side) == seen.shape(side) && colour.shape(side) == seen.shape(side),
                "photos of different sizes");
    require(label.shape(0) == height && label.shape(1) == width && blended.size() == 3 * height * width,
            "results of another size");
    require(parity == 0 || parity == 1, "a parity that is none");
    const splat::MosaicJob job{static_cast<int>(photos),
                               static_cast<int>(width),
                               static_cast<int>(height),
                               parity,
                               seen.data(),
                               colour.data(),
                               cost.data()};
    const nb::gil_scoped_release released;
    splat::compose_mosaic(job, {label.data(), blended.data()});
}

void add_votes(splat::CellVotes& votes, const Plane<const float>& depth, const Plane<const std::uint8_t>& confidence,
               const Camera& camera, const Rectangle& window) {
    const splat::DepthPicture picture{camera_of(camera), depth.data(), confidence.data()};
    const auto [left, top, right, bottom] = window;
    require(is_size(picture.camera, depth.shape(0), depth.shape(1)) &&
                is_size(picture.camera, confidence.shape(0), confidence.shape(1)),
            "depths that are not of the camera's size");
    require(left >= 0 && top >= 0 && left < right && top < bottom && right <= picture.camera.width &&
                bottom <= picture.camera.height,
            "a window beyond the photo");
    const nb::gil_scoped_release released;
    votes.add(picture, left, top, right, bottom);
}

template <class A>
bool fits(const A& plane, std::size_t rows, const splat::CellVotes& votes) {
    return plane.shape(0) == rows && plane.shape(1) == static_cast<std::size_t>(votes.cells());
}

void find_layers(splat::CellVotes& votes, const Plane<double>& height, const Plane<std::int32_t>& count,
                 const Plane<double>& cover) {
    constexpr std::size_t kRows = splat::kSurfaceLayers;
    require(fits(height, kRows, votes) && fits(count, kRows, votes) && fits(cover, kRows, votes),
            "results of another size");
    const nb::gil_scoped_release released;
    votes.layers({height.data(), count.data(), cover.data()});
}

void fit(splat::CellVotes& votes, const Row<const double>& start, const Row<double>& height, const Row<double>& sigma,
         const Row<std::int32_t>& photos) {
    const auto cells = static_cast<std::size_t>(votes.cells());
    require(start.shape(0) == cells && height.shape(0) == cells && sigma.shape(0) == cells && photos.shape(0) == cells,
            "starts or results of another size");
    const nb::gil_scoped_release released;
    votes.fit(start.data(), {height.data(), sigma.data(), photos.data()});
}

}  // namespace

void bind_surface(nb::module_& m) {
    m.attr("SEEN") = splat::kSeen, m.attr("THROUGH") = splat::kThrough;
    m.attr("MIXED") = splat::kMixed, m.attr("UNKNOWN") = splat::kUnknown;
    m.attr("MOSAIC_MARGIN") = splat::kMosaicMargin;
    m.def("look", &look, "depth"_a.noconvert(), "camera"_a, "places"_a, "sines"_a.noconvert().none(), "least"_a,
          "said"_a.noconvert());
    m.def("rate", &rate, "camera"_a, "places"_a, "cell"_a, "said"_a.noconvert(), "cost"_a.noconvert(),
          "seen"_a.noconvert());
    m.def("confirm", &confirm, "inverse"_a.noconvert(), "camera"_a, "places"_a, "agreeing"_a, "sums"_a.noconvert(),
          "votes"_a.noconvert());
    m.def("sample_photo", &sample_photo, "photo"_a, "places"_a, "cell"_a, "seen"_a.noconvert(), "colour"_a.noconvert());
    m.def("compose_mosaic", &compose_mosaic, "seen"_a.noconvert(), "cost"_a.noconvert(), "colour"_a.noconvert(),
          "parity"_a, "label"_a.noconvert(), "blended"_a.noconvert());
    m.def("keep_best", &keep_best, "seen"_a.noconvert(), "cost"_a.noconvert(), "most"_a, "seen_by"_a.noconvert());
    nb::class_<splat::CellVotes>(m, "CellVotes")
        .def(
            "__init__",
            [](splat::CellVotes* self, const Lattice& lattice, const Rectangle& tile,
               const std::array<double, 2>& relief) { new (self) splat::CellVotes(tile_of(lattice, tile, relief)); },
            "lattice"_a, "tile"_a, "relief"_a)
        .def("add", &add_votes, "depth"_a.noconvert(), "confidence"_a.noconvert(), "camera"_a, "window"_a)
        .def("layers", &find_layers, "height"_a.noconvert(), "count"_a.noconvert(), "cover"_a.noconvert())
        .def("fit", &fit, "start"_a.noconvert(), "height"_a.noconvert(), "sigma"_a.noconvert(), "photos"_a.noconvert());
}
