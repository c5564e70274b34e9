// Depth of field without Python: a file of `torchdof export`, run by onnxruntime's C++ API.
//
// Usage: run_onnx dof.onnx image.pfm depth.pfm out.pfm FOCUS_M F_NUMBER
//
// Images are PFM files of linear light (`oiiotool photo.png --colorconvert srgb linear -o image.pfm` writes one); depth
// is a PFM file in metres. Copy the class DepthOfField; the rest reads and writes files.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <array>
#include <bit>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

// Planar channels, rows from the top, as the exported file takes them.
struct Image {
    std::int64_t channels = 0, height = 0, width = 0;
    std::vector<float> values;
};

// An exported file, ready to render.
class DepthOfField {
public:
    explicit DepthOfField(const std::filesystem::path& file) : session_(environment_, file.c_str(), Ort::SessionOptions{}) {}

    // `image`: linear light. `depth`: metres along the optical axis; NaN, zero and negative stay sharp.
    Image operator()(const Image& image, const Image& depth, float focus_m, float f_number) {
        if (depth.channels != 1 || depth.height != image.height || depth.width != image.width)
            throw std::invalid_argument("depth must have one channel and the size of the image");
        const std::array names{"image", "depth", "focus_m", "f_number"};
        const std::array inputs{tensor(image.values.data(), {1, image.channels, image.height, image.width}),
                                tensor(depth.values.data(), {1, 1, depth.height, depth.width}),
                                tensor(&focus_m, {1}), tensor(&f_number, {1})};
        const char* output = "out";
        const auto outputs = session_.Run(Ort::RunOptions{}, names.data(), inputs.data(), inputs.size(), &output, 1);
        Image out{image.channels, image.height, image.width, std::vector<float>(image.values.size())};
        std::copy_n(outputs.front().GetTensorData<float>(), out.values.size(), out.values.begin());
        return out;
    }

private:
    // A view of the caller's values: onnxruntime does not write to its inputs.
    Ort::Value tensor(const float* values, const std::vector<std::int64_t>& shape) const {
        std::size_t count = 1;
        for (const auto side : shape) count *= static_cast<std::size_t>(side);
        return Ort::Value::CreateTensor<float>(memory_, const_cast<float*>(values), count, shape.data(), shape.size());
    }

    Ort::Env environment_{ORT_LOGGING_LEVEL_ERROR, "torchdof"};
    Ort::Session session_;
    Ort::MemoryInfo memory_ = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
};

// A PFM file: one line each for kind, size and byte order (negative: little endian), then rows from the bottom up.
Image read_pfm(const std::filesystem::path& path) {
    std::ifstream file(path, std::ios::binary);
    std::string kind;
    double order = 0.0;
    Image image;
    file >> kind >> image.width >> image.height >> order;
    file.get();
    if (!file || (kind != "PF" && kind != "Pf") || order >= 0.0 || image.width < 1 || image.height < 1)
        throw std::runtime_error(path.string() + " is not a little-endian PFM file");
    image.channels = kind == "PF" ? 3 : 1;
    image.values.resize(static_cast<std::size_t>(image.channels * image.height * image.width));
    std::vector<float> row(static_cast<std::size_t>(image.channels * image.width));
    for (auto y = image.height - 1; y >= 0; --y) {
        file.read(reinterpret_cast<char*>(row.data()), static_cast<std::streamsize>(row.size() * sizeof(float)));
        if (!file) throw std::runtime_error(path.string() + " ends before its last row");
        for (std::int64_t x = 0; x < image.width; ++x)
            for (std::int64_t c = 0; c < image.channels; ++c)
                image.values[(c * image.height + y) * image.width + x] = row[x * image.channels + c];
    }
    return image;
}

void write_pfm(const std::filesystem::path& path, const Image& image) {
    std::ofstream file(path, std::ios::binary);
    file << (image.channels == 3 ? "PF" : "Pf") << '\n' << image.width << ' ' << image.height << "\n-1.0\n";
    std::vector<float> row(static_cast<std::size_t>(image.channels * image.width));
    for (auto y = image.height - 1; y >= 0; --y) {
        for (std::int64_t x = 0; x < image.width; ++x)
            for (std::int64_t c = 0; c < image.channels; ++c)
                row[x * image.channels + c] = image.values[(c * image.height + y) * image.width + x];
        file.write(reinterpret_cast<const char*>(row.data()), static_cast<std::streamsize>(row.size() * sizeof(float)));
    }
    if (!file.flush()) throw std::runtime_error("cannot write " + path.string());
}

int main(int count, char** arguments) try {
    static_assert(std::endian::native == std::endian::little);
    if (count != 7) {
        std::fprintf(stderr, "usage: %s MODEL IMAGE.pfm DEPTH.pfm OUT.pfm FOCUS_M F_NUMBER\n", arguments[0]);
        return 2;
    }
    const auto image = read_pfm(arguments[2]);
    const auto depth = read_pfm(arguments[3]);
    DepthOfField depth_of_field(arguments[1]);
    const auto begin = std::chrono::steady_clock::now();
    const auto out = depth_of_field(image, depth, std::stof(arguments[5]), std::stof(arguments[6]));
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - begin;
    write_pfm(arguments[4], out);
    std::printf("%lld x %lld: %.2f s\n", static_cast<long long>(out.width), static_cast<long long>(out.height),
                seconds.count());
} catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
