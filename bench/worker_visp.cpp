// ViSP's model-based tracker on a sequence of RGB-D images, for bench/peer_tracks.py.
//
//   g++ -O2 -o visp_tracker worker_visp.cpp $(pkg-config --cflags --libs visp)
//   visp_tracker MODEL.cao SEQUENCE.bin FEATURES
//
// SEQUENCE.bin: int32 frames, height, width; float64 fx, fy, cx, cy; float64 4 x 4 the pose in the
// first image; then for each frame uint8 gray (H, W) and float32 depth (H, W) [m]. FEATURES: a sum
// of 1 (edges), 2 (KLT) and 8 (dense depth). Prints a line a frame: 16 numbers of the pose, the
// processor's seconds, and 1 where the tracker did not give up. A tracker that gives up is set to
// its last pose again.

#include <visp3/core/vpConfig.h>
#include <visp3/core/vpImage.h>
#include <visp3/mbt/vpMbGenericTracker.h>

#include <cstdint>
#include <cstdio>
#include <ctime>
#include <fstream>
#include <iostream>
#include <map>
#include <string>
#include <vector>

template <class T> static void take(std::ifstream &file, T *to, size_t count)
{
  if (!file.read(reinterpret_cast<char *>(to), static_cast<std::streamsize>(count * sizeof(T))))
    throw std::runtime_error("the sequence is cut off");
}

static int run(const char *model, const char *sequence, int features)
{
  std::ifstream file(sequence, std::ios::binary);
  std::int32_t size[3];
  double camera[4], start[16];
  take(file, size, 3);
  take(file, camera, 4);
  take(file, start, 16);
  const unsigned int height = size[1], width = size[2];

  vpMbGenericTracker tracker;
  tracker.setTrackerType(features);
  vpCameraParameters K(camera[0], camera[1], camera[2], camera[3]);
  tracker.setCameraParameters(K);
  if (features & vpMbGenericTracker::EDGE_TRACKER) {
    vpMe edges;
    edges.setMaskSize(5);
    edges.setMaskNumber(180);
    edges.setRange(8);
    edges.setThreshold(5000);
    edges.setMu1(0.5);
    edges.setMu2(0.5);
    edges.setSampleStep(4);
    tracker.setMovingEdge(edges);
  }
  if (features & vpMbGenericTracker::KLT_TRACKER) {
    vpKltOpencv corners;
    corners.setMaxFeatures(300);
    corners.setWindowSize(5);
    corners.setQuality(0.01);
    corners.setMinDistance(5);
    corners.setHarrisFreeParameter(0.01);
    corners.setBlockSize(3);
    corners.setPyramidLevels(3);
    tracker.setKltOpencv(corners);
    tracker.setKltMaskBorder(5);
  }
  tracker.setDepthDenseSamplingStep(2, 2);
  tracker.setAngleAppear(vpMath::rad(85));
  tracker.setAngleDisappear(vpMath::rad(89));
  tracker.setNearClippingDistance(0.1);
  tracker.setFarClippingDistance(3.0);
  tracker.setScanLineVisibilityTest(true);
  tracker.loadModel(model);

  vpHomogeneousMatrix pose;
  for (unsigned int i = 0; i < 16; ++i)
    pose[i / 4][i % 4] = start[i];
  vpImage<unsigned char> gray(height, width);
  std::vector<float> depth(static_cast<size_t>(height) * width);
  std::vector<vpColVector> cloud(depth.size(), vpColVector(3));
  const std::string name = tracker.getCameraNames().front();
  std::map<std::string, const vpImage<unsigned char> *> images{{name, &gray}};
  std::map<std::string, const std::vector<vpColVector> *> clouds{{name, &cloud}};
  std::map<std::string, unsigned int> widths{{name, width}}, heights{{name, height}};
  for (int frame = 0; frame < size[0]; ++frame) {
    take(file, gray.bitmap, depth.size());
    take(file, depth.data(), depth.size());
    const std::clock_t begun = std::clock();
    for (unsigned int v = 0; v < height; ++v)
      for (unsigned int u = 0; u < width; ++u) {
        const double z = depth[v * width + u];
        vpColVector &point = cloud[v * width + u];
        point[0] = (u - camera[2]) / camera[0] * z;
        point[1] = (v - camera[3]) / camera[1] * z;
        point[2] = z;
      }
    bool kept = true;
    try {
      if (frame == 0)
        tracker.initFromPose(gray, pose);
      tracker.track(images, clouds, widths, heights);
      tracker.getPose(pose);
    } catch (const vpException &error) {
      std::cerr << "frame " << frame << ": " << error.what() << std::endl;
      kept = false;
      tracker.initFromPose(gray, pose);
    }
    const double seconds = static_cast<double>(std::clock() - begun) / CLOCKS_PER_SEC;
    for (unsigned int i = 0; i < 16; ++i)
      std::printf("%.9g ", pose[i / 4][i % 4]);
    std::printf("%.6f %d\n", seconds, kept ? 1 : 0);
  }
  return 0;
}

int main(int count, char **words)
{
  if (count != 4) {
    std::cerr << "visp_tracker MODEL.cao SEQUENCE.bin FEATURES" << std::endl;
    return 2;
  }
  try {
    return run(words[1], words[2], std::stoi(words[3]));
  } catch (const std::exception &error) {
    std::cerr << error.what() << std::endl;
    return 1;
  }
}
