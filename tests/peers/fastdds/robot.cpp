// A robot on Fast DDS: publishes what it reads from stdin, a line a message, and writes the maps that it hears to
// stdout. It knows nothing of echogrid but the ROS messages. It uses one interface alone, loopback by default.
//
//   robot DOMAIN [reliable] [variance] [poses] [on=ADDRESS]
//
//   tf STAMP PARENT CHILD X Y Z QX QY QZ QW          on /tf, reliable and volatile, as robot_state_publisher has it
//   static STAMP PARENT CHILD X Y Z QX QY QZ QW      on /tf_static, reliable and transient local
//   odom STAMP FRAME CHILD X Y Z QX QY QZ QW         on /odom
//   range TOPIC STAMP FRAME FOV MIN MAX RANGE        best effort and volatile, or reliable
//   initial STAMP FRAME X Y Z QX QY QZ QW VXX VYY VAA   on /initialpose, as RViz has it
//   text TOPIC TEXT                                  a message of another type
//   matched N                                        waits until all topics so far have N subscribers
//   at SECONDS                                       waits until so long after the first "at"
//
// Stamps are written SEC.NANOSECONDS. Each map is a line: "map" or "local", stamp, frame, resolution, columns, rows,
// origin x and y, microseconds since the last range of that stamp was published (or -1), and the cells, one character
// each: # 100, . 0, ? -1, ! any other. With "poses" so is each transform of a frame of odometry that somebody else sends
// ("tf", stamp, parent, child, x, y, sine and cosine of half the heading) and each /amcl_pose ("pose", stamp, frame, x,
// y, sine and cosine of half the heading, variances of x, y and heading).
#include <array>
#include <chrono>
#include <cstdio>
#include <iostream>
#include <map>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

#include "rosPubSubTypes.h"

using namespace eprosima::fastdds::dds;
using eprosima::fastdds::rtps::UDPv4TransportDescriptor;
using Clock = std::chrono::steady_clock;

static std::mutex guard;
static std::map<long, Clock::time_point> sent;  // by stamp in microseconds: others may hold it as a double

static long microseconds(const builtin_interfaces::msg::dds_::Time_& time) {
    return time.sec() * 1000000L + (time.nanosec() + 500L) / 1000L;
}

static builtin_interfaces::msg::dds_::Time_ time_of(const std::string& text) {
    builtin_interfaces::msg::dds_::Time_ time;
    const auto dot = text.find('.');
    time.sec(std::stoi(text.substr(0, dot)));
    time.nanosec(dot == std::string::npos ? 0 : std::stoul(text.substr(dot + 1)));
    return time;
}

static std::array<double, 7> numbers(std::istream& words) {
    std::array<double, 7> found{};
    for (double& value : found) {
        std::string word;
        words >> word;
        value = std::stod(word);  // unlike a stream it knows nan and inf
    }
    return found;
}

class MapListener : public DataReaderListener {
public:
    explicit MapListener(std::string name) : name_(std::move(name)) {}

    void on_data_available(DataReader* reader) override {
        nav_msgs::msg::dds_::OccupancyGrid_ grid;
        SampleInfo info;
        while (reader->take_next_sample(&grid, &info) == ReturnCode_t::RETCODE_OK) {
            const auto now = Clock::now();
            if (!info.valid_data) {
                continue;
            }
            const std::lock_guard<std::mutex> lock(guard);
            const auto& stamp = grid.header().stamp();
            const auto found = sent.find(microseconds(stamp));
            const long delay = found == sent.end() ? -1 : std::chrono::duration_cast<std::chrono::microseconds>(
                now - found->second).count();
            std::string cells;
            for (const char value : grid.data()) {
                const int cell = static_cast<signed char>(value);
                cells += cell == 100 ? '#' : cell == 0 ? '.' : cell == -1 ? '?' : '!';
            }
            const auto& at = grid.info().origin().position();
            std::printf("%s %d.%09u %s %.9g %u %u %.9g %.9g %ld %s\n", name_.c_str(), stamp.sec(), stamp.nanosec(),
                        grid.header().frame_id().c_str(), grid.info().resolution(), grid.info().width(),
                        grid.info().height(), at.x(), at.y(), delay, cells.c_str());
            std::fflush(stdout);
        }
    }

private:
    std::string name_;
};

class TransformListener : public DataReaderListener {
public:
    void on_data_available(DataReader* reader) override {
        tf2_msgs::msg::dds_::TFMessage_ message;
        SampleInfo info;
        while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
            const std::lock_guard<std::mutex> lock(guard);
            for (const auto& each : message.transforms()) {
                if (!info.valid_data || each.child_frame_id().find("odom") == std::string::npos) {
                    continue;
                }
                const auto& at = each.transform();
                std::printf("tf %d.%09u %s %s %.9g %.9g %.9g %.9g\n", each.header().stamp().sec(),
                            each.header().stamp().nanosec(), each.header().frame_id().c_str(),
                            each.child_frame_id().c_str(), at.translation().x(), at.translation().y(),
                            at.rotation().z(), at.rotation().w());
                std::fflush(stdout);
            }
        }
    }
};

class PoseListener : public DataReaderListener {
public:
    void on_data_available(DataReader* reader) override {
        geometry_msgs::msg::dds_::PoseWithCovarianceStamped_ message;
        SampleInfo info;
        while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) {
                continue;
            }
            const std::lock_guard<std::mutex> lock(guard);
            const auto& stamp = message.header().stamp();
            const auto& at = message.pose().pose();
            const auto& spread = message.pose().covariance();
            std::printf("pose %d.%09u %s %.9g %.9g %.9g %.9g %.9g %.9g %.9g\n", stamp.sec(), stamp.nanosec(),
                        message.header().frame_id().c_str(), at.position().x(), at.position().y(),
                        at.orientation().z(), at.orientation().w(), spread[0], spread[7], spread[35]);
            std::fflush(stdout);
        }
    }
};

static DomainParticipant* joined(int domain, const std::string& address) {
    DomainParticipantQos qos;
    auto udp = std::make_shared<UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back(address);
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    DomainParticipant* made = DomainParticipantFactory::get_instance()->create_participant(domain, qos);
    if (!made) {
        throw std::runtime_error("no participant");
    }
    return made;
}

class Robot {
public:
    Robot(int domain, bool reliable, bool variance, bool poses, const std::string& address)
        : reliable_(reliable), variance_(variance), participant_(joined(domain, address)) {
        publisher_ = participant_->create_publisher(PUBLISHER_QOS_DEFAULT);
        using Map = nav_msgs::msg::dds_::OccupancyGrid_PubSubType;
        const auto map = "nav_msgs::msg::dds_::OccupancyGrid_";
        listen<Map>(participant_, "rt/map", map, TRANSIENT_LOCAL_DURABILITY_QOS, RELIABLE_RELIABILITY_QOS, 1, &maps_);
        listen<Map>(participant_, "rt/local_map", map, VOLATILE_DURABILITY_QOS, BEST_EFFORT_RELIABILITY_QOS, 10,
                    &locals_);
        if (poses) {  // by a participant of its own, which the topics of this one do not wait for
            listener_ = joined(domain, address);
            listen<tf2_msgs::msg::dds_::TFMessage_PubSubType>(
                listener_, "rt/tf", "tf2_msgs::msg::dds_::TFMessage_", VOLATILE_DURABILITY_QOS,
                RELIABLE_RELIABILITY_QOS, 100, &transforms_);
            listen<geometry_msgs::msg::dds_::PoseWithCovarianceStamped_PubSubType>(
                listener_, "rt/amcl_pose", "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
                TRANSIENT_LOCAL_DURABILITY_QOS, RELIABLE_RELIABILITY_QOS, 1, &robot_poses_);
        }
    }

    ~Robot() {
        for (DomainParticipant* each : {participant_, listener_}) {
            if (each) {
                each->delete_contained_entities();
                DomainParticipantFactory::get_instance()->delete_participant(each);
            }
        }
    }

    void play(std::istream& in) {
        std::string line;
        while (std::getline(in, line)) {
            std::istringstream words(line);
            std::string what;
            words >> what;
            if (what == "tf" || what == "static") {
                transform(what == "static", words);
            } else if (what == "odom") {
                odometry(words);
            } else if (what == "initial") {
                initial(words);
            } else if (what == "range") {
                range(words);
            } else if (what == "text") {
                text(words);
            } else if (what == "matched") {
                int count = 1;
                words >> count;
                matched(count);
            } else if (what == "at") {
                double seconds = 0;
                words >> seconds;
                if (start_ == Clock::time_point()) {
                    start_ = Clock::now();
                }
                std::this_thread::sleep_until(start_ + std::chrono::duration<double>(seconds));
            } else if (!what.empty()) {
                throw std::runtime_error("unknown line: " + line);
            }
        }
        // Who has not heard it all yet would find nobody to ask once the writers are gone.
        for (const auto& each : writers_) {
            each.second->wait_for_acknowledgments(eprosima::fastrtps::Duration_t(10, 0));
        }
    }

private:
    template <class Type>
    DataWriter* writer(const std::string& topic, const std::string& type_name, bool reliable, bool kept) {
        auto& writer = writers_["rt/" + topic];
        if (!writer) {
            DataWriterQos qos;
            qos.reliability().kind = reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
            qos.durability().kind = kept ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
            qos.history().kind = KEEP_LAST_HISTORY_QOS;
            qos.history().depth = 100;
            qos.publish_mode().kind = SYNCHRONOUS_PUBLISH_MODE;
            qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
            writer = publisher_->create_datawriter(topic_of<Type>(participant_, "rt/" + topic, type_name), qos);
            if (!writer) {
                throw std::runtime_error("no writer for " + topic);
            }
        }
        return writer;
    }

    template <class Type>
    static Topic* topic_of(DomainParticipant* of, const std::string& name, const std::string& type_name) {
        TypeSupport(new Type()).register_type(of, type_name);
        return of->create_topic(name, type_name, TOPIC_QOS_DEFAULT);
    }

    template <class Type>
    static void listen(DomainParticipant* of, const std::string& topic, const std::string& type_name,
                       DurabilityQosPolicyKind durability, ReliabilityQosPolicyKind reliability, int depth,
                       DataReaderListener* listener) {
        DataReaderQos qos;
        qos.durability().kind = durability;
        qos.reliability().kind = reliability;
        qos.history().kind = KEEP_LAST_HISTORY_QOS;
        qos.history().depth = depth;
        qos.endpoint().history_memory_policy = eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
        Subscriber* subscriber = of->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
        if (!subscriber->create_datareader(topic_of<Type>(of, topic, type_name), qos, listener)) {
            throw std::runtime_error("no reader for " + topic);
        }
    }

    void matched(int count) {
        for (const auto& each : writers_) {
            PublicationMatchedStatus status;
            do {
                std::this_thread::sleep_for(std::chrono::milliseconds(10));
                each.second->get_publication_matched_status(status);
            } while (status.current_count < count);
        }
        // The readers learn of the match a little later than the writers.
        std::this_thread::sleep_for(std::chrono::milliseconds(300));
    }

    void transform(bool fixed, std::istream& words) {
        std::string stamp, parent, child;
        words >> stamp >> parent >> child;
        const auto v = numbers(words);
        geometry_msgs::msg::dds_::TransformStamped_ one;
        one.header().stamp(time_of(stamp));
        one.header().frame_id(parent);
        one.child_frame_id(child);
        auto& pose = one.transform();
        pose.translation().x(v[0]), pose.translation().y(v[1]), pose.translation().z(v[2]);
        pose.rotation().x(v[3]), pose.rotation().y(v[4]), pose.rotation().z(v[5]), pose.rotation().w(v[6]);
        using Type = tf2_msgs::msg::dds_::TFMessage_PubSubType;
        const auto type = "tf2_msgs::msg::dds_::TFMessage_";
        tf2_msgs::msg::dds_::TFMessage_ message;
        message.transforms().push_back(one);
        writer<Type>(fixed ? "tf_static" : "tf", type, true, fixed)->write(&message);
    }

    void odometry(std::istream& words) {
        std::string stamp, parent, child;
        words >> stamp >> parent >> child;
        const auto v = numbers(words);
        nav_msgs::msg::dds_::Odometry_ message;
        message.header().stamp(time_of(stamp));
        message.header().frame_id(parent);
        message.child_frame_id(child);
        auto& pose = message.pose().pose();
        pose.position().x(v[0]), pose.position().y(v[1]), pose.position().z(v[2]);
        pose.orientation().x(v[3]), pose.orientation().y(v[4]), pose.orientation().z(v[5]), pose.orientation().w(v[6]);
        writer<nav_msgs::msg::dds_::Odometry_PubSubType>("odom", "nav_msgs::msg::dds_::Odometry_", true, false)
            ->write(&message);
    }

    void initial(std::istream& words) {
        std::string stamp, frame;
        words >> stamp >> frame;
        const auto v = numbers(words);
        geometry_msgs::msg::dds_::PoseWithCovarianceStamped_ message;
        message.header().stamp(time_of(stamp));
        message.header().frame_id(frame);
        auto& pose = message.pose().pose();
        pose.position().x(v[0]), pose.position().y(v[1]), pose.position().z(v[2]);
        pose.orientation().x(v[3]), pose.orientation().y(v[4]), pose.orientation().z(v[5]), pose.orientation().w(v[6]);
        auto& spread = message.pose().covariance();
        words >> spread[0] >> spread[7] >> spread[35];
        writer<geometry_msgs::msg::dds_::PoseWithCovarianceStamped_PubSubType>(
            "initialpose", "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_", true, false)->write(&message);
    }

    void range(std::istream& words) {
        using namespace sensor_msgs::msg::dds_;
        std::string topic, stamp, frame, v[4];
        words >> topic >> stamp >> frame >> v[0] >> v[1] >> v[2] >> v[3];
        const auto type = "sensor_msgs::msg::dds_::Range_";
        const auto fill = [&](auto& message) {
            message.header().stamp(time_of(stamp));
            message.header().frame_id(frame);
            message.radiation_type(0);
            message.field_of_view(std::stof(v[0]));
            message.min_range(std::stof(v[1]));
            message.max_range(std::stof(v[2]));
            message.range(std::stof(v[3]));
        };
        const auto time = time_of(stamp);
        {
            const std::lock_guard<std::mutex> lock(guard);
            sent[microseconds(time)] = Clock::now();
            while (sent.size() > 1000) {
                sent.erase(sent.begin());
            }
        }
        if (variance_) {
            RangeWithVariance_ message;
            fill(message);
            message.variance(0.01F);
            writer<RangeWithVariance_PubSubType>(topic, type, reliable_, false)->write(&message);
        } else {
            Range_ message;
            fill(message);
            writer<Range_PubSubType>(topic, type, reliable_, false)->write(&message);
        }
    }

    void text(std::istream& words) {
        std::string topic;
        std_msgs::msg::dds_::Header_ message;
        words >> topic >> message.frame_id();
        writer<std_msgs::msg::dds_::Header_PubSubType>(topic, "std_msgs::msg::dds_::Header_", false, false)
            ->write(&message);
    }

    bool reliable_, variance_;
    DomainParticipant* participant_ = nullptr;
    DomainParticipant* listener_ = nullptr;
    Publisher* publisher_ = nullptr;
    std::map<std::string, DataWriter*> writers_;
    MapListener maps_{"map"}, locals_{"local"};
    TransformListener transforms_;
    PoseListener robot_poses_;
    Clock::time_point start_;
};

int main(int argc, char** argv) {
    if (argc < 2) {
        std::fprintf(stderr, "robot: found no domain, expected: robot DOMAIN [reliable] [variance] [poses] [on=ADDRESS]\n");
        return 2;
    }
    bool reliable = false, variance = false, poses = false;
    std::string address = "127.0.0.1";
    for (int i = 2; i < argc; ++i) {
        const std::string word = argv[i];
        reliable = reliable || word == "reliable";
        variance = variance || word == "variance";
        poses = poses || word == "poses";
        address = word.rfind("on=", 0) == 0 ? word.substr(3) : address;
    }
    try {
        Robot(std::stoi(argv[1]), reliable, variance, poses, address).play(std::cin);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "robot: %s\n", error.what());
        return 2;
    }
    return 0;
}
