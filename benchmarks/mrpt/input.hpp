// What the harnesses read: a header of numbers by name, then doubles; and how they refuse what is wrong.
#pragma once

#include <cmath>
#include <cstdlib>
#include <istream>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

struct Wrong : std::runtime_error
{
    using std::runtime_error::runtime_error;
};

[[noreturn]] inline void fail(const std::string& where, const std::string& found, const std::string& expected)
{
    throw Wrong(where + ": found " + found + ", expected " + expected);
}

// The numbers of the header, each taken once by its name.
class Header
{
   public:
    explicit Header(std::istream& in)
    {
        std::string line;
        while (std::getline(in, line))
        {
            if (line == "data") return;
            const auto blank = line.find(' ');
            const std::string text = blank == std::string::npos ? "" : line.substr(blank + 1);
            char* end = nullptr;
            const double value = std::strtod(text.c_str(), &end);
            if (text.empty() || *end != '\0') fail("header", "a line that is not \"key number\"", "one, or \"data\"");
            numbers_[line.substr(0, blank)] = value;
        }
        fail("header", "its end without a line \"data\"", "a drive as benchmarks/mrpt.py writes it");
    }

    double take(const std::string& key, double low, double high)
    {
        const auto it = numbers_.find(key);
        if (it == numbers_.end()) fail(key, "nothing", "a number");
        const double value = it->second;
        if (!(low <= value && value <= high))
            fail(key, std::to_string(value), "a number from " + std::to_string(low) + " to " + std::to_string(high));
        numbers_.erase(it);
        return value;
    }

    size_t count(const std::string& key, double high)
    {
        const double value = take(key, 1, high);
        if (value != std::floor(value)) fail(key, std::to_string(value), "a whole number");
        return static_cast<size_t>(value);
    }

    bool flag(const std::string& key) { return take(key, 0, 1) != 0; }

    void check_all_taken() const
    {
        if (!numbers_.empty()) fail(numbers_.begin()->first, "an unknown key", "those that benchmarks/mrpt.py writes");
    }

   private:
    std::map<std::string, double> numbers_;
};

inline std::vector<double> read_doubles(std::istream& in, size_t count, const std::string& what)
{
    std::vector<double> values(count);
    in.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(count * sizeof(double)));
    if (static_cast<size_t>(in.gcount()) != count * sizeof(double))
        fail(what, "the end of the input", std::to_string(count) + " doubles");
    return values;
}
