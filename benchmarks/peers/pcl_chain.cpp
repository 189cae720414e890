// The classical chain in PCL: outliers, plane, Euclidean clusters, hull, box by moment of inertia.
//
// A line of stdin names a file of float32 x, y, z, intensity (KITTI's .bin) that lies within the region. The
// answer is a line of "ms kept clusters", then one of x y length width yaw height bottom for each cluster, then
// an empty one. Reading is not timed.
#include <pcl/features/moment_of_inertia_estimation.h>
#include <pcl/filters/extract_indices.h>
#include <pcl/filters/statistical_outlier_removal.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/sample_consensus/method_types.h>
#include <pcl/sample_consensus/model_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/segmentation/extract_clusters.h>
#include <pcl/segmentation/sac_segmentation.h>
#include <pcl/surface/convex_hull.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

using Point = pcl::PointXYZ;
using Cloud = pcl::PointCloud<Point>;

// As in benchmarks/peers/chains.py.
constexpr int kNeighbours = 20;
constexpr double kNumStd = 2.0;
constexpr int kHypotheses = 128;
constexpr double kPlaneToleranceM = 0.2;
constexpr double kLinkM = 0.5;
constexpr int kMinPoints = 10;
constexpr int kMaxPoints = 20000;

Cloud::Ptr readBin(const std::string& path) {
  Cloud::Ptr cloud(new Cloud);
  std::ifstream file(path, std::ios::binary);
  float row[4];
  while (file.read(reinterpret_cast<char*>(row), sizeof row)) cloud->push_back(Point(row[0], row[1], row[2]));
  return cloud;
}

Cloud::Ptr removeOutliers(const Cloud::Ptr& cloud) {
  Cloud::Ptr kept(new Cloud);
  pcl::StatisticalOutlierRemoval<Point> filter;
  filter.setInputCloud(cloud);
  filter.setMeanK(kNeighbours);
  filter.setStddevMulThresh(kNumStd);
  filter.filter(*kept);
  return kept;
}

Cloud::Ptr removeGround(const Cloud::Ptr& cloud) {
  pcl::SACSegmentation<Point> segmentation;
  segmentation.setOptimizeCoefficients(true);
  segmentation.setModelType(pcl::SACMODEL_PERPENDICULAR_PLANE);
  segmentation.setAxis(Eigen::Vector3f::UnitZ());
  segmentation.setEpsAngle(0.15);
  segmentation.setMethodType(pcl::SAC_RANSAC);
  segmentation.setMaxIterations(kHypotheses);
  segmentation.setDistanceThreshold(kPlaneToleranceM);
  segmentation.setInputCloud(cloud);
  pcl::PointIndices::Ptr ground(new pcl::PointIndices);
  pcl::ModelCoefficients plane;
  segmentation.segment(*ground, plane);
  // What is above the plane, not what is merely off it: below it are reflections.
  Cloud::Ptr above(new Cloud);
  if (ground->indices.empty()) return above;
  const auto& v = plane.values;
  const float sign = v[2] > 0 ? 1.0f : -1.0f;
  for (const Point& p : *cloud)
    if (sign * (v[0] * p.x + v[1] * p.y + v[2] * p.z + v[3]) > kPlaneToleranceM) above->push_back(p);
  return above;
}

std::vector<pcl::PointIndices> findClusters(const Cloud::Ptr& cloud) {
  std::vector<pcl::PointIndices> clusters;
  if (cloud->empty()) return clusters;
  pcl::search::KdTree<Point>::Ptr tree(new pcl::search::KdTree<Point>);
  tree->setInputCloud(cloud);
  pcl::EuclideanClusterExtraction<Point> extraction;
  extraction.setClusterTolerance(kLinkM);
  extraction.setMinClusterSize(kMinPoints);
  extraction.setMaxClusterSize(kMaxPoints);
  extraction.setSearchMethod(tree);
  extraction.setInputCloud(cloud);
  extraction.extract(clusters);
  return clusters;
}

// x, y, length, width, yaw, height and bottom of the box along the principal axes in the ground plane.
std::vector<double> fitBox(const Cloud::Ptr& cloud, const pcl::PointIndices& cluster) {
  Cloud::Ptr flat(new Cloud), outline(new Cloud);
  float low = 1e9f, high = -1e9f;
  for (int index : cluster.indices) {
    const Point& p = (*cloud)[index];
    low = std::min(low, p.z);
    high = std::max(high, p.z);
    flat->push_back(Point(p.x, p.y, 0.0f));
  }
  pcl::ConvexHull<Point> hull;
  hull.setDimension(2);
  hull.setInputCloud(flat);
  hull.reconstruct(*outline);
  pcl::MomentOfInertiaEstimation<Point> moments;
  moments.setInputCloud(outline->size() >= 3 ? outline : flat);
  moments.compute();
  Point least, most, middle;
  Eigen::Matrix3f turn;
  moments.getOBB(least, most, middle, turn);
  // Of the three axes, the one that stands upright has no extent.
  int first = 0, second = 1;
  if (std::abs(turn(2, 0)) > 0.5f) first = 2;
  if (std::abs(turn(2, 1)) > 0.5f) second = 2;
  const float extents[3] = {most.x - least.x, most.y - least.y, most.z - least.z};
  if (extents[second] > extents[first]) std::swap(first, second);
  return {middle.x, middle.y, extents[first], extents[second],
          std::atan2(turn(1, first), turn(0, first)), high - low, low};
}

int main() {
  std::string path;
  while (std::getline(std::cin, path)) {
    const Cloud::Ptr sweep = readBin(path);
    const auto start = std::chrono::steady_clock::now();
    const Cloud::Ptr kept = removeGround(removeOutliers(sweep));
    const std::vector<pcl::PointIndices> clusters = findClusters(kept);
    std::vector<std::vector<double>> boxes;
    for (const auto& cluster : clusters) boxes.push_back(fitBox(kept, cluster));
    const std::chrono::duration<double, std::milli> spent = std::chrono::steady_clock::now() - start;
    std::printf("%.3f %zu %zu\n", spent.count(), kept->size(), clusters.size());
    for (const auto& box : boxes) {
      for (double value : box) std::printf("%.5f ", value);
      std::printf("\n");
    }
    std::printf("\n");
    std::fflush(stdout);
  }
}
